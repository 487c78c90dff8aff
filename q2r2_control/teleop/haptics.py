"""Short vibrations that tell a hand about the state of its arm."""

from __future__ import annotations

from typing import NamedTuple

from q2r2_control.teleop.arm import ArmState
from q2r2_control.types import Event, HapticFeedback


class Pulse(NamedTuple):
    """One vibration."""

    frequency: float  # 0..1
    amplitude: float  # 0..1
    duration: float  # [s]


ENGAGED = Pulse(0.5, 0.4, 0.08)
PAUSED = Pulse(0.3, 0.3, 0.08)
FAULT = Pulse(1.0, 1.0, 0.3)
SLIP = Pulse(0.2, 0.2, 0.05)
_SLIP_STEP = 0.02  # the target slips by this between two pulses [m]
_SLIP_ANGLE_STEP = 0.1  # or by this [rad]


class HapticPulses:
    """Vibrations of one hand: on engaging, on pausing, longer on a fault, and whenever a target slips by a step.

    The app vibrates until the next message, so the end of a pulse is a message as well.
    """

    def __init__(self, hand: str) -> None:
        self._hand = hand
        self._ends: float | None = None
        self._strength = 0.0
        self._felt = (0.0, 0.0)
        self._waiting: Pulse | None = None

    def tell(self, event: Event) -> None:
        """Start the pulse for a change of the arm's state; that of a refused press is that of a fault."""
        if event.destination == ArmState.ENGAGED:
            self._want(ENGAGED)
        elif event.source == ArmState.ENGAGED:
            self._want(PAUSED if event.destination != ArmState.PAUSED else FAULT)
        elif event.destination == ArmState.PAUSED and event.source in (ArmState.PAUSED, ArmState.ALIGNING):
            self._want(FAULT)

    def slip(self, slip: float, slip_angle: float) -> None:
        """Start a pulse where the target has slipped by another step since engaging [m, rad]."""
        if slip < self._felt[0] or slip_angle < self._felt[1]:
            self._felt = (slip, slip_angle)
        elif slip >= self._felt[0] + _SLIP_STEP or slip_angle >= self._felt[1] + _SLIP_ANGLE_STEP:
            self._felt = (slip, slip_angle)
            self._want(SLIP)

    def at(self, now: float) -> HapticFeedback | None:
        """What to send at ``now`` [s], or None."""
        pulse, self._waiting = self._waiting, None
        if pulse is not None and (self._ends is None or pulse.amplitude >= self._strength):
            self._ends, self._strength = now + pulse.duration, pulse.amplitude
            return HapticFeedback(self._hand, pulse.frequency, pulse.amplitude)
        if self._ends is not None and now >= self._ends:
            self._ends = None
            return HapticFeedback(self._hand, 0.0, 0.0)
        return None

    def _want(self, pulse: Pulse) -> None:
        if self._waiting is None or pulse.amplitude >= self._waiting.amplitude:
            self._waiting = pulse
