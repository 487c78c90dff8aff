"""Views of a run or a headset. They listen, nothing waits for them, and none needs ROS."""
