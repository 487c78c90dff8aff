"""Steps before a node runs; nothing here needs rclpy, and no node needs more of it than ``middleware``."""
