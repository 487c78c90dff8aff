"""One tick of control, which the in-process loop and the ROS nodes share."""
