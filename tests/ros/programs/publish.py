"""Publishes one message steadily: ``python -m tests.ros.programs.publish PACKAGE/TYPE TOPIC JSON``, at 100 Hz."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from typing import Any

import rclpy

from q2r2_control.ros.base_node import COMMAND_QOS
from tests.ros.programs import until_interrupted

PERIOD = 0.01  # [s]


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """``message`` with ``fields`` set, which may be nested."""
    for name, value in fields.items():
        setattr(message, name, fill(getattr(message, name), value) if isinstance(value, dict) else value)
    return message


def main() -> None:
    package, name = sys.argv[1].split("/")
    message = fill(getattr(import_module(f"{package}.msg"), name)(), json.loads(sys.argv[3]))
    rclpy.init()
    node = rclpy.create_node("sender")
    publisher = node.create_publisher(type(message), sys.argv[2], COMMAND_QOS)
    node.create_timer(PERIOD, lambda: publisher.publish(message))
    with until_interrupted():
        rclpy.spin(node)


if __name__ == "__main__":
    main()
