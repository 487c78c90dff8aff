"""Steps before a node runs. Nothing here needs rclpy, and nodes need only ``middleware`` from this package."""
