"""Conversion between ROS messages and the package's own data, and checks whether the other side can be relied on."""
