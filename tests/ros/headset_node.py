"""Publishes quest2ros/OVR2ROSInputs until it is ended: ``python -m tests.ros.headset_node``."""

from __future__ import annotations

import rclpy
from quest2ros.msg import OVR2ROSInputs
from rclpy.executors import ExternalShutdownException

TOPIC = "q2r_left_hand_inputs"
INPUTS = {
    "button_upper": False,
    "button_lower": True,
    "thumb_stick_horizontal": -0.5,
    "thumb_stick_vertical": 0.25,
    "press_index": 0.75,
    "press_middle": 1.0,
}


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("headset")
    publisher = node.create_publisher(OVR2ROSInputs, TOPIC, 10)
    node.create_timer(0.02, lambda: publisher.publish(OVR2ROSInputs(**INPUTS)))
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()


if __name__ == "__main__":
    main()
