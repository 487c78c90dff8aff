"""Prints joint states and nodes' states as lines of JSON until it is ended: ``python -m tests.ros.observer NODE ...``.

For tests that cannot be where the topics are. Times are of the machine's steady clock, the same for all processes.
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from q2r2_control.ros.base_node import STREAM_QOS


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("observer")

    def say(kind: str, value: Any) -> None:
        print(json.dumps({"t": time.monotonic(), "kind": kind, "value": value}), flush=True)

    def on_joint_state(message: JointState) -> None:
        say("joints", [list(message.name), list(message.position), list(message.velocity)])

    node.create_subscription(JointState, "/joint_states", on_joint_state, STREAM_QOS)

    def on_state(name: str, message: String) -> None:
        say(name, json.loads(message.data))

    for name in sys.argv[1:]:
        node.create_subscription(String, f"/{name}/state", partial(on_state, name), 10)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()


if __name__ == "__main__":
    main()
