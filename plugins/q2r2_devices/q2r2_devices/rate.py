"""The hand of a rate device, which has a velocity instead of a pose.

The cap of a SpaceMouse and the stick of a gamepad return to their centre when they are let go. Their deflection is
therefore taken as the velocity of a hand, and the integral of the velocity is the hand's pose. With this pose the
teleop layer works as with every other hand: anchors, leash, gate.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control import Array, HandInputs, HandSample

# While a device is deflected, it sends a reading every 8 or 16 ms. If no reading comes for longer than this [s], the
# device is switched off or out of range. Its last velocity then no longer counts.
SILENCE = 0.15
_PERIOD = 1.0 / 90.0  # Period of the samples [s].
_LONGEST_STEP = 0.1  # A gap between two polls counts as at most this long [s].


class RateReading(NamedTuple):
    """The velocity of a hand, and its controls. The axes are x forwards, y to the left, z up."""

    velocity: Array  # (6,) Linear [m/s] and angular [rad/s], in the input's own axes, which do not turn with the hand.
    inputs: HandInputs


class RateHand:
    """Integrates the velocity of one hand."""

    def __init__(self, hand: str) -> None:
        self._hand = hand
        self._position, self._rotation = np.zeros(3), pin.Quaternion.Identity()
        self._reading: RateReading | None = None
        self._heard = self._next = self._last = -np.inf  # Times of the last reading, next sample, and last poll [s].

    def poll(self, readings: list[RateReading | None], now: float) -> list[HandSample]:
        """Return the samples since the last poll. There are none while a deflected device is silent.

        Args:
            readings: The new readings, in order. A None among them says that the device was lost at that time.
            now: The time by the clock of the samples' stamps [s].
        """
        self._integrate(now)
        samples = []
        for reading in readings:
            before, self._reading, self._heard = self._reading, reading, now
            if reading is None:
                self._next = -np.inf  # The device may be lost because a run has ended. The next run has another clock.
            # Each change of a control has a sample of its own, so that a short tap is not lost.
            if before is not None and reading is not None and before.inputs != reading.inputs:
                samples.append(self._sample(reading.inputs, now))
        if self._reading is not None and now >= self._next and not self._is_silent(now):
            self._next = now + _PERIOD
            samples.append(self._sample(self._reading.inputs, now))
        return samples

    def _is_silent(self, now: float) -> bool:
        return self._reading is not None and bool(self._reading.velocity.any()) and now - self._heard > SILENCE

    def _integrate(self, now: float) -> None:
        dt, self._last = min(max(now - self._last, 0.0), _LONGEST_STEP), now
        if self._reading is None or self._is_silent(now):
            return
        linear, angular = np.split(self._reading.velocity * dt, 2)
        self._position = self._position + linear
        self._rotation = pin.Quaternion(pin.exp3(angular)) * self._rotation
        self._rotation.normalize()

    def _sample(self, inputs: HandInputs, now: float) -> HandSample:
        return HandSample(self._hand, self._position, self._rotation.coeffs().copy(), now, inputs, now)
