"""Asks the built-in controller, which has to prove the bodies of fingers, how far a gripper may be opened."""

from __future__ import annotations

import math

from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from q2r2_control.ros.base_node import LATCHED_QOS


def wanted_topic(target_topic: str) -> str:
    """Where the sender of an arm's targets asks for openings."""
    return f"{target_topic}/wanted_opening"


class OpeningGrants:
    """One arm's gripper; openings are 0 closed .. 1 fully open.

    It says what is wanted, and what the gripper was commanded to last: a controller that starts anew then knows where
    the gripper may be, and does not take an old wish for a new one.
    """

    def __init__(self, node: Node, controller: str, arm: str, target_topic: str) -> None:
        """``controller``: the built-in one's name; ``target_topic``: where the arm's targets go."""
        self._wanted, self._commanded = math.nan, math.nan
        self._answer: tuple[float, float] | None = None  # what was wanted, and what is granted of it
        self._publisher = node.create_publisher(Float64MultiArray, wanted_topic(target_topic), LATCHED_QOS)
        self._node, self._topic = node, f"{controller}/opening/{arm}"
        node.create_subscription(Float64MultiArray, self._topic, self._on_answer, LATCHED_QOS)

    @property
    def answered(self) -> bool:
        """Whether there is a controller that answers."""
        return int(self._node.count_publishers(self._topic)) > 0

    @property
    def granted(self) -> float | None:
        """The opening that may be commanded now, on the way to the one that was asked for; None: not answered yet."""
        if self._answer is None or self._answer[0] != self._wanted:
            return None
        return self._answer[1]

    def ask(self, opening: float) -> None:
        """Ask for an opening, until another one is asked for."""
        self._wanted = opening
        self._tell()

    def commanded(self, opening: float) -> None:
        """Say what the gripper is commanded to."""
        self._commanded = opening
        self._tell()

    def _tell(self) -> None:
        self._publisher.publish(Float64MultiArray(data=[self._wanted, self._commanded]))

    def _on_answer(self, message: Float64MultiArray) -> None:
        if len(message.data) == 2 and all(0.0 <= number <= 1.0 for number in message.data):
            self._answer = message.data[0], message.data[1]
