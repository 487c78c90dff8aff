"""Streams one target from a process of its own: ``python -m tests.ros.target_sender TOPIC X Y Z QX QY QZ QW``."""

from __future__ import annotations

import sys
from contextlib import suppress

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException

from q2r2_control.ros.base_node import COMMAND_QOS


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("sender")
    publisher = node.create_publisher(PoseStamped, sys.argv[1], COMMAND_QOS)
    message = PoseStamped()
    message.header.frame_id = "world"
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z, *quaternion = map(float, sys.argv[2:])
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion
    node.create_timer(0.01, lambda: publisher.publish(message))
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
