"""What the two arms' teleop nodes tell each other: their stance, that they live, and their faults."""

from __future__ import annotations

import math
from typing import Any

from std_msgs.msg import String

from q2r2_control.ros.node import LATCHED_QOS
from q2r2_control.types import SIDES

_ALIVE = "alive"
_ENDED = "ended"
_PERIOD = 0.04  # of the sign of life [s]


class ArmLink:
    """One arm's end of the link.

    The stance is latched at ``/<robot>/<arm>/stance``; ``/<robot>/<arm>/link`` says "alive" 25 times a second, and
    otherwise the fault that pauses the other arm. An arm whose other node never came is alone and works alone.
    """

    def __init__(self, node: Any, robot: str, arm: str, stance: str, timeout: float) -> None:
        self.other = SIDES[1 - SIDES.index(arm)]
        self._node, self._stance, self._timeout = node, stance, timeout
        self._other_stance: str | None = None
        self._heard = -math.inf  # -inf: not yet, or ended in order
        self._told: str | None = None
        self._stances = node.create_publisher(String, f"/{robot}/{arm}/stance", LATCHED_QOS)
        self._link = node.create_publisher(String, f"/{robot}/{arm}/link", 10)
        self._stance_of_other = f"/{robot}/{self.other}/stance"
        node.create_subscription(String, self._stance_of_other, self._on_stance, LATCHED_QOS)
        node.create_subscription(String, f"/{robot}/{self.other}/link", self._on_link, 10)
        node.create_timer(_PERIOD, lambda: self._say(_ALIVE))
        self._stances.publish(String(data=stance))

    @property
    def disagreement(self) -> str | None:
        """What the two arms do not agree on, in one line."""
        if self._node.count_publishers(self._stance_of_other) == 0:
            self._other_stance = None  # what is gone has no say, and whoever comes next speaks for itself
        theirs = self._other_stance
        if theirs in (None, self._stance):
            return None
        return f"this arm is set to {self._stance}, the {self.other} one to {theirs}: set mirror alike in both"

    def report(self, fault: str) -> None:
        """Tell the other arm to pause."""
        self._say(fault)

    def take_fault(self, now: float) -> str | None:
        """Why this arm has to pause because of the other, once for each reason."""
        told, self._told = self._told, None
        if told is None and now - self._heard > self._timeout and self._heard > -math.inf:
            told = f"its node is silent for {now - self._heard:.2f} s"
            self._heard = -math.inf
        return told and f"linked to {self.other}: {told}"

    def close(self) -> None:
        """Say that this end is closed in order."""
        self._say(_ENDED)

    def _say(self, text: str) -> None:
        self._link.publish(String(data=text))

    def _on_stance(self, message: String) -> None:
        self._other_stance = message.data

    def _on_link(self, message: String) -> None:
        self._heard = self._node.now
        if message.data == _ENDED:
            self._heard = -math.inf
        if message.data != _ALIVE:
            self._told = message.data
