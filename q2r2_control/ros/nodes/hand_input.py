"""``hand_input``: publishes the hands of any installed input, as the headset's node does for the headset."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

from quest2ros.msg import OVR2ROSHapticFeedback

from q2r2_control.config.cell import load_config
from q2r2_control.inputs.base import make_input
from q2r2_control.inputs.messages import HandMessage, HandPose, MessageType
from q2r2_control.inputs.session import HAND_TOPICS, HAPTIC_TOPICS
from q2r2_control.ros.base_node import OK, STREAM_QOS, WARN, BaseNode, run_node
from q2r2_control.ros.bridge.hand_topics import HandPublishers
from q2r2_control.types import HandSample, HapticFeedback

_PERIOD = 0.002  # between two polls [s]


class HandInput(BaseNode):
    """Polls an input and publishes each sample. A pose with a fault is left out, so that its arm pauses.

    Raises :class:`ConfigError` for an unknown input, and for a binding to a control that it does not have.
    """

    ticks = True
    priority = 37

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("hand_input", **kwargs)
        config = load_config(self.parameter("config", "config/dual_iiwa7.yaml", "YAML of the cell"))
        name = self.parameter("input", config.input, "An installed input.")
        self._input = make_input(name, config)
        config.teleop.bindings.check_device(self._input.controls)
        self._title, self._samples = name, 0
        kinds = MessageType.POSE, MessageType.INPUTS
        self._topics = {(topic.hand, topic.kind): name for name, topic in HAND_TOPICS.items() if topic.kind in kinds}
        self._publishers_of_hands = HandPublishers(self, self._topics.values())
        for hand, topic in HAPTIC_TOPICS.items():
            self.create_subscription(OVR2ROSHapticFeedback, topic, self._vibrate(hand), STREAM_QOS)
        self._input.start()
        self.create_timer(_PERIOD, self._tick)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        """Whether the input is connected."""
        values = {"samples": self._samples, "sent": self._publishers_of_hands.sent}
        connected = self._input.connected
        return OK if connected else WARN, self._title if connected else f"{self._title} is not connected", values

    def close(self) -> None:
        """Close the input."""
        self._input.close()

    def _tick(self) -> None:
        for sample in self._input.poll(self.now):
            self._publish(sample)

    def _publish(self, sample: HandSample) -> None:
        messages: dict[MessageType, HandMessage] = {MessageType.INPUTS: sample.inputs}
        if sample.fault is None:
            messages[MessageType.POSE] = HandPose(sample.position, sample.quaternion, sample.pose_stamp, "")
        for kind, message in messages.items():
            self._publishers_of_hands.publish(self._topics[sample.hand, kind], message, "", sample.pose_stamp)
        self._samples += 1

    def _vibrate(self, hand: str) -> Callable[[OVR2ROSHapticFeedback], None]:
        def vibrate(message: OVR2ROSHapticFeedback) -> None:
            self._input.send_haptic(HapticFeedback(hand, message.frequency, message.amplitude))

        return vibrate


def main() -> int:
    """Run the node."""
    return run_node(HandInput)


if __name__ == "__main__":
    sys.exit(main())
