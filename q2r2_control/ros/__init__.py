"""ROS 2: needs rclpy, which the rest of the package does not."""
