"""A solver that works against us: of everything a QP allows it answers the worst, and it sees no separation row."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.control.qp import QpProblem
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

# "towards_nearest": the vertex of the box that brings the pair with the least margin together fastest.
# "corner": a random vertex, for a while. "again": the last answer, whatever the box is now.
ATTACKS = ("towards_nearest", "corner", "again")
_PATIENCE = 200  # ticks that one pair or one corner is pursued for, at most
_CANDIDATES = 4  # the pairs with the least margins, of which one is pursued


class WorstSolver:
    """Makes the answers of one attack after another. Distances and their gradients are Coal's and Pinocchio's."""

    def __init__(self, robot: Robot, random: np.random.Generator) -> None:
        self._robot, self._random = robot, random
        self._data = robot.model.createData()
        self._geometry: pin.GeometryData = robot.collision_model.createData()
        self._signs = np.ones(robot.model.nv)
        self._last = np.zeros(robot.model.nv)
        self._left = 0
        self._rank = 0

    def answer(self, attack: str, problem: QpProblem, q: Array, kept: Array) -> Array:
        """Next velocities (nv,) [rad/s] at the posture ``q`` (nv,), where pairs keep ``kept`` (p,) [m]."""
        if attack == "again":
            return self._last
        self._left -= 1
        renewed = self._left <= 0
        if renewed:
            self._left = int(self._random.integers(1, _PATIENCE))
            self._rank = int(self._random.geometric(0.6)) - 1
        if attack == "towards_nearest":
            self._signs = -np.sign(self._gradient(q, kept))
        elif renewed:
            self._signs = self._random.choice([-1.0, 1.0], size=len(self._signs))
        self._last = np.where(self._signs > 0.0, problem.upper, problem.lower)
        return self._last

    def _gradient(self, q: Array, kept: Array) -> Array:
        """Of the distance of a pair with one of the least margins, with respect to ``q`` (nv,) [m/rad]."""
        model, data, geometries = self._robot.model, self._data, self._robot.collision_model
        pin.computeJointJacobians(model, data, q)
        pin.updateGeometryPlacements(model, data, geometries, self._geometry)
        pin.computeDistances(geometries, self._geometry)
        results = self._geometry.distanceResults
        margins = np.array([result.min_distance for result in results]) - kept
        nearest = int(np.argsort(margins)[min(self._rank, len(margins) - 1, _CANDIDATES - 1)])
        result, pair = results[nearest], geometries.collisionPairs[nearest]
        points = result.getNearestPoint1(), result.getNearestPoint2()
        normal = points[1] - points[0]
        normal = normal / max(float(np.linalg.norm(normal)), 1e-12) * (1.0 if result.min_distance >= 0.0 else -1.0)
        gradient = np.zeros(model.nv)
        for side, geometry, point in ((-1.0, pair.first, points[0]), (1.0, pair.second, points[1])):
            joint = geometries.geometryObjects[geometry].parentJoint
            jacobian = pin.getJointJacobian(model, data, joint, pin.LOCAL_WORLD_ALIGNED)
            lever = point - data.oMi[joint].translation
            gradient += side * normal @ (jacobian[:3] - pin.skew(lever) @ jacobian[3:])
        return gradient
