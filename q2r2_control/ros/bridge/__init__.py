"""Between ROS and the package's own data: messages in and out, and whether the other side can be relied on."""
