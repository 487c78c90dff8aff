"""The hands of a lerobot teleoperator as the input of a cell.

The hands move the arms only while lerobot requests actions of the teleoperator.
"""

from __future__ import annotations

from q2r2_control import QUEST_CONTROLS, DeviceControls, HandSample, HapticFeedback, Input
from q2r2_control.inputs import WebInput


class HandsDoor:
    """An :class:`Input` with the samples of the attached device, but without samples while the policy moves the arms.

    It is the input with which a person can take over from the cell's policy.
    """

    # All controls that a device may have, because the device is not known yet when the cell is created.
    controls = DeviceControls(QUEST_CONTROLS.buttons + WebInput.controls.buttons, QUEST_CONTROLS.axes)

    def __init__(self) -> None:
        self.operator: Input | None = None  # The attached device; None if no device is attached.
        self.open = False  # True while the hands may move the arms.
        self._was_open = False

    @property
    def connected(self) -> bool:
        return not self.open or (self.operator is not None and self.operator.connected)

    def start(self) -> None:
        """Do nothing. The device was started when it was attached, and it stays attached after a run."""

    def poll(self, now: float) -> list[HandSample]:
        open, was_open, self._was_open = self.open, self._was_open, self.open
        if self.operator is None or not open:
            return []
        samples = self.operator.poll(now)
        return samples if was_open else []  # Samples from the time before lerobot requested actions are dropped.

    def send_haptic(self, feedback: HapticFeedback) -> None:
        if self.operator is not None and self.open:
            self.operator.send_haptic(feedback)

    def close(self) -> None:
        """Do nothing; see :meth:`start`."""
