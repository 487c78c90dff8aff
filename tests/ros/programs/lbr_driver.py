"""Prints the commands of LBR robots and follows positions: ``python -m tests.ros.programs.lbr_driver KIND ARM ...``.

KIND is a message of lbr_fri_idl, its topics are ``/ARM/command/...`` as the robots' drivers listen to. Each command is
a line of JSON. Positions go on to a robot that listens to ``joint_commands``.
"""

from __future__ import annotations

import json
import sys
from functools import partial
from importlib import import_module
from typing import Any

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState

from tests.ros.programs import until_interrupted

TOPICS = {"LBRJointPositionCommand": "joint_position", "LBRTorqueCommand": "torque"}


class Listener(Node):
    def __init__(self, kind: str, arms: list[str]) -> None:
        super().__init__("lbr_driver")
        self._moves = kind == "LBRJointPositionCommand"
        self._commands = self.create_publisher(JointState, "joint_commands", 10)
        message = getattr(import_module("lbr_fri_idl.msg"), kind)
        for arm in arms:
            topic = f"/{arm}/command/{TOPICS[kind]}"
            self.create_subscription(message, topic, partial(self._on_command, arm), 100)
        print("listens", flush=True)

    def _on_command(self, arm: str, message: Any) -> None:
        q, tau = message.joint_position.tolist(), getattr(message, "torque", None)
        entry = {
            "arm": arm,
            "q": q,
            "tau": None if tau is None else tau.tolist(),
            "t": self.get_clock().now().nanoseconds,
        }
        print(json.dumps(entry), flush=True)
        if self._moves:
            self._commands.publish(JointState(name=[f"{arm}_A{joint}" for joint in range(1, 8)], position=q))


def main() -> None:
    rclpy.init()
    with until_interrupted():
        rclpy.spin(Listener(sys.argv[1], sys.argv[2:]))


if __name__ == "__main__":
    main()
