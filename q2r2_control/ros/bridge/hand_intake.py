"""What one hand sends to an arm's node, and what it is made to feel. Which hand that is may change."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from quest2ros.msg import OVR2ROSHapticFeedback, OVR2ROSInputs

from q2r2_control.inputs.samples import SampleQueue
from q2r2_control.inputs.session import HAPTIC_TOPICS
from q2r2_control.ros.base_node import COMMAND_QOS, STREAM_QOS, BaseNode
from q2r2_control.ros.bridge.messages import age, hand_sample
from q2r2_control.ros.monitoring.endpoints import Publishers
from q2r2_control.types import HandSample, HapticFeedback


class HandIntake:
    """Topics of the hand that drives an arm; those of the other hand from when it first does.

    Messages come as ``on_pose`` and ``on_inputs``, which give them to :meth:`put_pose` and :meth:`put_inputs`.
    """

    def __init__(
        self,
        node: BaseNode,
        hand: str,
        timeout: float,
        on_pose: Callable[[PoseStamped], None],
        on_inputs: Callable[[OVR2ROSInputs], None],
    ) -> None:
        self._node, self._timeout = node, timeout
        self._callbacks = (PoseStamped, "pose", on_pose), (OVR2ROSInputs, "inputs", on_inputs)
        self._publishers: dict[str, Publishers] = {}  # of each hand
        self._haptics: dict[str, Any] = {}
        self._samples = SampleQueue()
        self._received = -math.inf  # the message that is being taken was [s]
        self.follow(hand)

    def follow(self, hand: str) -> None:
        """Take what this hand sends from now on; nothing that came before counts."""
        self.hand = hand
        self._samples.take()
        self._pose: tuple[PoseStamped, float] | None = None
        self._inputs: tuple[OVR2ROSInputs | None, float] = (None, -math.inf)
        if hand in self._publishers:
            return
        self._publishers[hand] = Publishers(self._node, (_topic(hand, "pose"), _topic(hand, "inputs")))
        self._haptics[hand] = self._node.create_publisher(OVR2ROSHapticFeedback, HAPTIC_TOPICS[hand], COMMAND_QOS)
        for kind, what, callback in self._callbacks:
            take = partial(self._take, hand, callback)
            self._node.create_subscription(kind, _topic(hand, what), take, STREAM_QOS)

    def put_pose(self, message: PoseStamped) -> None:
        """Take a pose of the hand."""
        self._pose = message, self._received
        self._put()

    def put_inputs(self, message: OVR2ROSInputs) -> None:
        """Take buttons, triggers and stick of the hand."""
        self._inputs = message, self._received
        self._put()

    def take(self) -> list[HandSample]:
        """All samples since the last call, oldest first."""
        return self._samples.take()

    @property
    def stamps(self) -> tuple[float, float]:
        """Receipt times of the newest pose and inputs; -inf before the first [s]."""
        return -math.inf if self._pose is None else self._pose[1], self._inputs[1]

    def silence(self, now: float) -> str | None:
        """One line if data are missing, and from which node: poses are needed to move, buttons to stop."""
        ages = {what: now - stamp for what, stamp in zip(("pose", "inputs"), self.stamps, strict=True)}
        missing = {what: age for what, age in ages.items() if age > self._timeout}
        if not missing:
            return None
        first = next(iter(missing))
        what = "data" if len(missing) == len(ages) else {"pose": "pose", "inputs": "button data"}[first]
        source = self._publishers[self.hand].source(_topic(self.hand, first))
        age = min(missing.values())
        return f"no {what} of the {self.hand} hand{source} " + (f"for {age:.2f} s" if age < math.inf else "yet")

    def feel(self, pulse: HapticFeedback) -> None:
        """Let a hand that drives this arm, or did, feel something."""
        message = OVR2ROSHapticFeedback(frequency=pulse.frequency, amplitude=pulse.amplitude)
        self._haptics[pulse.hand].publish(message)

    def _take(self, hand: str, callback: Callable[[Any], None], message: Any, info: Mapping[str, Any]) -> None:
        if hand == self.hand:
            self._received = self._node.now - age(info)
            callback(message)

    def _put(self) -> None:
        if self._pose is not None:
            self._samples.put(hand_sample(self.hand, *self._pose, *self._inputs))


def _topic(hand: str, what: str) -> str:
    return f"q2r_{hand}_hand_{what}"
