"""Targets as far ahead as a plant is late, so that its arms are where the targets are."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.types import Array

_SMOOTHING = 0.01  # time constant of a target's velocity [s]
_FASTEST = 3.0, 20.0  # what is faster is a step of the target, and no motion of it [m/s], [rad/s]
_REST = 1e-6  # what is slower stands still [m/s], [rad/s]


class TargetLead:
    """Leads each target by its own smoothed velocity.

    A target at constant velocity is led by exactly the delay. One that stops at once is overshot by its velocity times
    the delay at most, for some ``_SMOOTHING``. One that rests is not changed.
    """

    def __init__(self) -> None:
        self._last: dict[str, pin.SE3] = {}
        self._velocities: dict[str, Array] = {}  # linear, and angular in the target's frame (6,) [m/s], [rad/s]

    def ahead(self, targets: Mapping[str, pin.SE3 | None], dt: float, delay: float) -> dict[str, pin.SE3 | None]:
        """The world poses where ``targets``, ``dt`` [s] after the last ones, will be in ``delay`` [s]."""
        velocities, self._velocities = self._velocities, {}
        led: dict[str, pin.SE3 | None] = dict(targets)
        for arm, pose in targets.items():
            if pose is None or arm not in self._last or not dt > 0.0:
                continue
            velocity = self._velocities[arm] = velocities.get(arm, np.zeros(6))
            velocity += dt / (_SMOOTHING + dt) * (_velocity(self._last[arm], pose, dt) - velocity)
            if np.abs(velocity).max() > _REST:
                turned = pose.rotation @ pin.exp3(delay * velocity[3:])
                led[arm] = pin.SE3(turned, pose.translation + delay * velocity[:3])
        self._last = {arm: pose for arm, pose in targets.items() if pose is not None}
        return led


def _velocity(before: pin.SE3, pose: pin.SE3, dt: float) -> Array:
    """From one target to the next (6,); zero for a step."""
    linear = (pose.translation - before.translation) / dt
    angular = pin.log3(before.rotation.T @ pose.rotation) / dt
    if math.hypot(*linear) > _FASTEST[0] or math.hypot(*angular) > _FASTEST[1]:
        return np.zeros(6)
    return np.concatenate([linear, angular])
