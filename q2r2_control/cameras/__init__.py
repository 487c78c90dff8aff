"""Real cameras without ROS: devices of this computer and its network, each read by a process of its own."""
