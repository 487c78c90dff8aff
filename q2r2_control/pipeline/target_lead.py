"""Extrapolate targets by the delay of a plant, so that the real arms are where the targets are now."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.types import Array

_SMOOTHING = 0.01  # Time constant of the filter that smooths the velocity of a target [s].
_FASTEST = 3.0, 20.0  # If a target seems to move faster than this, it has jumped [m/s], [rad/s].
_REST = 1e-6  # A target that moves more slowly counts as a target at rest [m/s], [rad/s].


class TargetLead:
    """Extrapolates each target with its own smoothed velocity.

    A target at constant velocity is extrapolated by exactly the delay. If a target stops abruptly, the result goes too
    far by at most the target's velocity times the delay, for about ``_SMOOTHING`` [s]. A target at rest is not changed.
    """

    def __init__(self) -> None:
        self._last: dict[str, pin.SE3] = {}
        # For each arm, the target's linear velocity, and its angular velocity in its own frame (6,) [m/s], [rad/s].
        self._velocities: dict[str, Array] = {}

    def ahead(self, targets: Mapping[str, pin.SE3 | None], dt: float, delay: float) -> dict[str, pin.SE3 | None]:
        """Return where the targets will be after ``delay`` [s], in the world frame.

        Args:
            targets: The present targets by arm, in the world frame; None for an arm without a target.
            dt: Time since the targets of the previous call [s].
            delay: Delay of the plant [s].
        """
        velocities, self._velocities = self._velocities, {}
        extrapolated: dict[str, pin.SE3 | None] = dict(targets)
        for arm, pose in targets.items():
            if pose is None or arm not in self._last or not dt > 0.0:
                continue
            velocity = self._velocities[arm] = velocities.get(arm, np.zeros(6))
            velocity += dt / (_SMOOTHING + dt) * (_velocity(self._last[arm], pose, dt) - velocity)
            if np.abs(velocity).max() > _REST:
                turned = pose.rotation @ pin.exp3(delay * velocity[3:])
                extrapolated[arm] = pin.SE3(turned, pose.translation + delay * velocity[:3])
        self._last = {arm: pose for arm, pose in targets.items() if pose is not None}
        return extrapolated


def _velocity(before: pin.SE3, pose: pin.SE3, dt: float) -> Array:
    """Return the velocity from one target to the next (6,) [m/s], [rad/s]; zero if the target has jumped."""
    linear = (pose.translation - before.translation) / dt
    angular = pin.log3(before.rotation.T @ pose.rotation) / dt
    if math.hypot(*linear) > _FASTEST[0] or math.hypot(*angular) > _FASTEST[1]:
        return np.zeros(6)
    return np.concatenate([linear, angular])
