"""What people see of a run or a headset. All of it listens; nothing waits for it, and none of it needs ROS."""
