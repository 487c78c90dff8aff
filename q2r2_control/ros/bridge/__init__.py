"""Conversion between ROS messages and the package's own data, and checks whether the other nodes work."""
