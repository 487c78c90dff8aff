"""Whether the built-in controller follows an arm's targets, as it says itself."""

from __future__ import annotations

import math

from rclpy.node import Node
from std_msgs.msg import Bool

from q2r2_control.ros.bridge.base_node import LATCHED_QOS


class FollowWatch:
    """Without it an arm would count as engaged whose targets the controller refuses, and a press would pause it.

    The controller refuses a stream that it has dropped for reasons of its own, such as joint states that stalled, and
    may follow again only what begins anew. One that says nothing, as those of others, is believed to follow.
    """

    def __init__(self, node: Node, topic: str, patience: float) -> None:
        self._topic, self._patience = topic, patience
        self._follows: bool | None = None
        self._since = math.inf  # targets are sent that are not followed [s]
        node.create_subscription(Bool, topic, self._take, LATCHED_QOS)

    def refusal(self, asked: bool, now: float) -> str | None:
        """One line where targets, which are sent as long as ``asked``, have not been followed for too long."""
        if not asked or self._follows is not False:
            self._since = math.inf
            return None
        self._since = min(self._since, now)
        return f"{self._topic} says that targets are not followed" if now - self._since > self._patience else None

    def _take(self, message: Bool) -> None:
        self._follows = bool(message.data)
