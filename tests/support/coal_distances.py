"""Distances that the library Coal computes, without any kernel of this package."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


def coal_distances(robot: Robot, geometry: pin.GeometryModel, q: Array) -> Array:
    """Return the distances of all pairs of ``geometry`` (pairs,) [m] at the posture ``q`` (nv,)."""
    data, distances = robot.model.createData(), geometry.createData()
    pin.computeDistances(robot.model, data, geometry, distances, q)
    return np.array([result.min_distance for result in distances.distanceResults])
