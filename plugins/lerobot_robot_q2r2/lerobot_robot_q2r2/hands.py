"""Hands of a teleoperator at the door of a cell that lerobot runs: they count while lerobot asks for their actions."""

from __future__ import annotations

from q2r2_control import QUEST_CONTROLS, DeviceControls, HandSample, HapticFeedback, Input
from q2r2_control.inputs import WebInput


class HandsDoor:
    """The operator of a cell's policy: the hands of whichever device is attached. Implements :class:`Input`."""

    # Of all devices: which one it is going to be is not known when the cell is made.
    controls = DeviceControls(QUEST_CONTROLS.buttons + WebInput.controls.buttons, QUEST_CONTROLS.axes)

    def __init__(self) -> None:
        self.operator: Input | None = None  # whose hands they are, by who attaches them
        self.open = False  # whether the hands may drive
        self._was_open = False

    @property
    def connected(self) -> bool:
        return not self.open or (self.operator is not None and self.operator.connected)

    def start(self) -> None:
        """Nothing to do: the hands have begun when they were attached, and stay attached from run to run."""

    def poll(self, now: float) -> list[HandSample]:
        open, was_open, self._was_open = self.open, self._was_open, self.open
        if self.operator is None or not open:
            return []
        samples = self.operator.poll(now)
        return samples if was_open else []  # those that came while nobody asked for them say nothing

    def send_haptic(self, feedback: HapticFeedback) -> None:
        if self.operator is not None and self.open:
            self.operator.send_haptic(feedback)

    def close(self) -> None:
        """See :meth:`start`."""
