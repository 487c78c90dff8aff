"""Speeds of tools as Pinocchio finds them, for a check that does not trust the kernels."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


class MeasuredToolSpeeds:
    """The fastest tool of a robot."""

    def __init__(self, robot: Robot) -> None:
        self._model, self._data = robot.model, robot.model.createData()
        self._frames = [arm.frame_id for arm in robot.arms.values()]

    def fastest(self, q: Array, v: Array) -> float:
        """Speed of the fastest tool's origin [m/s] at ``q`` [rad], ``v`` [rad/s], (nv,) each or one row an instant."""
        return max(map(self._fastest, np.atleast_2d(q), np.atleast_2d(v)))

    def _fastest(self, q: Array, v: Array) -> float:
        pin.forwardKinematics(self._model, self._data, q, v)
        velocities = [
            pin.getFrameVelocity(self._model, self._data, frame, pin.LOCAL_WORLD_ALIGNED) for frame in self._frames
        ]
        return max(float(np.linalg.norm(velocity.linear)) for velocity in velocities)
