"""Views of a run or a headset. Nothing waits for a view, and no view needs ROS."""
