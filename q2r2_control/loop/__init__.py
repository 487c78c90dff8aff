"""One tick of control, for the in-process loop and the ROS nodes alike."""
