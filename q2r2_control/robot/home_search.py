"""Find a home posture for a cell whose YAML names no home, by sampling and a local search.

A good home has joints near the middle of their ranges. The tool is before and below the shoulder, points forwards and
down, and can move in all directions. Gravity requires clearly less torque than the joints' limits. The bodies are
clearly farther apart than the distances that they keep. The additional distance is greatest below the tool, because the
tool works below its home position. Two conditions are required: gravity is within the torque limits, and every pair is
slightly farther apart than its kept distance. If a posture violates one of them, its cost jumps.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from q2r2_control.robot.floor import FLOOR
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.types import Array

if TYPE_CHECKING:
    from q2r2_control.robot.robot import Arm, Robot

# Numbers of random postures, of the best postures, which are examined further, and of steps of the local search.
_SAMPLES, _BEST, _STEPS = 2000, 24, 150
_INSIDE = 0.85  # Share of its half range that each joint may use on both sides of the middle.
_HALF = np.pi / 2  # Greatest half range that is assumed for a joint [rad].
_WORK = np.array([0.62, 0.0, 0.05])  # Wanted position of the tool relative to the shoulder, in shares of the reach.
_AHEAD = np.array([0.8, 0.0, -0.6])  # Wanted direction in which the tool points.
# Least wanted singular value of the tool's Jacobian, whose lengths are divided by the reach of the arm.
_LEAST_GAIN = 0.15
_BORNE = 0.7  # Share of the torque limits that gravity may require.
_ROOM = 0.04  # Wanted distance of a pair in addition to the distance that it keeps [m].
# Wanted additional distance between the tool and the floor [m]. Scripted hands move down by less than this.
_BELOW = 0.16
_NEEDED = 0.005  # Required additional distance [m].
_MIRROR = np.array([1.0, -1.0, 1.0])
_ALONG_X, _ALONG_Z = np.diag([0.01, 0.0, 0.01])[[0, 2]]  # Points on two axes of the tool's frame [m].
_FAULTY = 100.0  # Cost of each requirement that a posture does not meet.


def find_home(
    robot: Robot, arm: str, q: Array, kept: Array, placed: Collection[str], like: Array | None = None
) -> Array:
    """Return the best home positions that were found for the joints of ``arm`` (n,) [rad].

    They may still violate a requirement.

    Args:
        robot: The robot.
        arm: The arm.
        q: The positions of all other joints (nv,) [rad].
        kept: The distance that each pair keeps (pairs,) [m].
        placed: Arms whose home is known. Pairs with other arms do not count.
        like: Positions of an equal arm (n,) [rad]. They are returned if they meet all requirements.
    """
    search = _HomeSearch(robot, arm, q, kept, placed)
    if like is not None and search.cost(like) < _FAULTY:
        return like
    return search.best(np.random.default_rng(0))


def mirrored_home(robot: Robot, arm: str, placed: str, q: Array) -> Array | None:
    """Return positions of ``arm`` (n,) [rad] that mirror the arm ``placed`` at ``q`` (nv,) in the plane y = 0.

    Joints of mirrored arms differ in their signs only. Those signs are taken that mirror the positions of the joints
    best. Returns None if the arms have different numbers of joints.
    """
    own, other = robot.arms[arm], robot.arms[placed]
    if len(own.joints) != len(other.joints):
        return None
    data = robot.model.createData()

    def points(posture: Array, of: Arm) -> Array:
        """Return the positions of joints and tool, and of points on the tool's axes (n, 3) [m]."""
        pin.forwardKinematics(robot.model, data, posture)
        tool = pin.updateFramePlacement(robot.model, data, of.frame_id)
        places = [data.oMi[int(joint) + 1].translation.copy() for joint in of.joints]
        return np.array([*places, tool.translation, *(tool.act(point) for point in (_ALONG_X, _ALONG_Z))])

    wanted = points(q, other) * _MIRROR
    angles, posture = q[other.joints], q.copy()

    def error(signs: tuple[float, ...]) -> float:
        posture[own.joints] = np.multiply(signs, angles)
        return float(np.square(points(posture, own) - wanted).sum())

    best = np.multiply(min(product((-1.0, 1.0), repeat=len(angles)), key=error), angles)
    return np.clip(best, robot.position_lower[own.joints], robot.position_upper[own.joints])


class _HomeSearch:
    def __init__(self, robot: Robot, arm: str, q: Array, kept: Array, placed: Collection[str]) -> None:
        self._robot, self._q, self._kept = robot, q.copy(), kept
        self._arm = robot.arms[arm]
        self._joints = self._arm.joints.tolist()
        lower, upper = robot.position_lower[self._joints], robot.position_upper[self._joints]
        self._middle = (lower + upper) / 2
        self._half = np.minimum((upper - lower) / 2, _HALF)
        self._box = self._middle - _INSIDE * self._half, self._middle + _INSIDE * self._half
        self._data = robot.model.createData()
        arms_of = [[robot.roles[link_of(name)].arms for name in names] for names in pair_names(robot.collision_model)]
        counts = np.array([all(not arms or arms & {arm, *placed} for arms in both) for both in arms_of], bool)
        last = {
            item.name
            for item in robot.collision_model.geometryObjects
            if item.parentJoint == robot.model.frames[self._arm.frame_id].parentJoint
        }
        below = [FLOOR in map(link_of, pair) and bool(last & {*pair}) for pair in pair_names(robot.collision_model)]
        self._rooms = (counts, _ROOM), (np.array(below, bool), _BELOW)
        self._reach = 1.0  # [m]
        # The second joint is taken as the shoulder, because in most arms the first joint turns the arm and the second
        # one lifts it.
        self._shoulder = int(self._joints[min(1, len(self._joints) - 1)]) + 1

    def best(self, random: np.random.Generator) -> Array:
        samples = random.uniform(*self._box, (_SAMPLES, len(self._joints)))
        self._reach = float(np.quantile([np.linalg.norm(self._lever(x)) for x in samples], 0.95)) or 1.0
        samples = samples[np.argsort([self._cost_of_posture(x) for x in samples])[:_BEST]]
        costs = [self.cost(x) for x in samples]
        x, cost, step = samples[int(np.argmin(costs))], min(costs), 0.3
        for _ in range(_STEPS):
            other = np.clip(x + random.normal(0.0, step, len(x)) * self._half, *self._box)
            if (its := self.cost(other)) < cost:
                x, cost, step = other, its, step * 1.2
            else:
                step = max(step * 0.97, 0.01)
        return x

    def _at(self, x: Array) -> Array:
        self._q[self._joints] = x
        return self._q

    def _lever(self, x: Array) -> Array:
        """Compute the model's data at ``x``, and return the tool's position relative to the shoulder (3,) [m]."""
        model, data = self._robot.model, self._data
        pin.computeJointJacobians(model, data, self._at(x))
        pin.updateFramePlacements(model, data)
        return np.asarray(data.oMf[self._arm.frame_id].translation - data.oMi[self._shoulder].translation)

    def _cost_of_posture(self, x: Array) -> float:
        lever = self._lever(x)
        model, data, frame = self._robot.model, self._data, self._arm.frame_id
        tool = data.oMf[frame].translation
        behind = (data.oMi[int(joint) + 1].translation for joint in self._joints[::-1])
        hand = next((tool - place for place in behind if np.linalg.norm(tool - place) > 0.05 * self._reach), lever)
        jacobian = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:, self._joints]
        jacobian[:3] /= self._reach
        gain = float(np.linalg.svd(jacobian, compute_uv=False)[min(len(x), 6) - 1])
        torques = np.abs(pin.computeGeneralizedGravity(model, data, self._at(x))) / self._robot.torque_limit
        return float(
            np.mean(((x - self._middle) / self._half) ** 2)
            + 3.0 * np.linalg.norm(lever / self._reach - _WORK)
            + 0.5 * (1.0 - hand @ _AHEAD / max(float(np.linalg.norm(hand)), 1e-9))
            + 5.0 * max(_LEAST_GAIN - gain, 0.0) / _LEAST_GAIN
            + _beyond(float(torques[self._joints].max()) - _BORNE, 1.0 - _BORNE)
        )

    def cost(self, x: Array) -> float:
        """Return the cost of the posture ``x``, including a cost for pairs of bodies that are too close."""
        cost, kept = self._cost_of_posture(x), self._robot.distance_values(self._at(x)) - self._kept
        for pairs, room in self._rooms:
            cost += _beyond(room - float(kept[pairs].min(initial=room)), room - _NEEDED)
        return cost


def _beyond(excess: float, most: float) -> float:
    """Return the cost of an ``excess``: 0 if it is not positive. If the excess is above ``most``, the cost jumps."""
    return max(excess, 0.0) / most + (_FAULTY * (1.0 + excess) if excess > most else 0.0)
