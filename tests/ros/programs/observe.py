"""Prints joint states and nodes' states as lines of JSON: ``python -m tests.ros.programs.observe NODE ...``.

For tests on another network than the topics. Times are of the machine's steady clock, the same for all processes.
"""

from __future__ import annotations

import json
import sys
import time
from functools import partial
from typing import Any

import rclpy
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from q2r2_control.ros.base_node import STREAM_QOS
from tests.ros.programs import until_interrupted


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("observer")

    def write(kind: str, value: Any) -> None:
        print(json.dumps({"t": time.monotonic(), "kind": kind, "value": value}), flush=True)

    def on_joint_state(message: JointState) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        write("joints", [list(message.name), list(message.position), list(message.velocity), stamp])

    node.create_subscription(JointState, "/joint_states", on_joint_state, STREAM_QOS)

    def on_state(name: str, message: String) -> None:
        write(name, json.loads(message.data))

    for name in sys.argv[1:]:
        node.create_subscription(String, f"/{name}/state", partial(on_state, name), 10)
    with until_interrupted():
        rclpy.spin(node)
    node.destroy_node()


if __name__ == "__main__":
    main()
