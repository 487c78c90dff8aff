"""``hand_input``: publishes the hands of any installed input, as the headset's node does for the headset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from q2r2_control.config.cell import load_config
from q2r2_control.inputs.base import make_input
from q2r2_control.inputs.messages import MessageType
from q2r2_control.ros.base_node import OK, WARN, BaseNode
from q2r2_control.ros.bridge.hand_topics import HandPublishers, subscribe_to_haptics

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
        self._hand_publishers = HandPublishers(self, kinds=(MessageType.POSE, MessageType.INPUTS))
        subscribe_to_haptics(self, self._input.send_haptic)
        self._input.start()
        self.create_timer(_PERIOD, self._tick)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        """Whether the input is connected."""
        values = {"samples": self._samples, "sent": self._hand_publishers.sent}
        connected = self._input.connected
        return OK if connected else WARN, self._title if connected else f"{self._title} is not connected", values

    def close(self) -> None:
        """Close the input."""
        self._input.close()

    def _tick(self) -> None:
        for sample in self._input.poll(self.now):
            self._hand_publishers.publish_sample(sample)
            self._samples += 1
