"""Speeds of tools that Pinocchio computes, for checks that do not rely on this package's own kinematics."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


class MeasuredToolSpeeds:
    """Computes the speed of a robot's fastest tool."""

    def __init__(self, robot: Robot) -> None:
        self._model, self._data = robot.model, robot.model.createData()
        self._frames = [arm.frame_id for arm in robot.arms.values()]

    def fastest(self, q: Array, v: Array) -> float:
        """Return the speed of the fastest tool's origin [m/s].

        ``q`` [rad] and ``v`` [rad/s] have the shape (nv,), or the shape (n, nv) with a row for each of n instants.
        """
        return max(map(self._fastest, np.atleast_2d(q), np.atleast_2d(v)))

    def _fastest(self, q: Array, v: Array) -> float:
        pin.forwardKinematics(self._model, self._data, q, v)
        velocities = [
            pin.getFrameVelocity(self._model, self._data, frame, pin.LOCAL_WORLD_ALIGNED) for frame in self._frames
        ]
        return max(float(np.linalg.norm(velocity.linear)) for velocity in velocities)
