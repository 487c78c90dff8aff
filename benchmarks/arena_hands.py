"""Scripted hands of the arena, and a judge that measures the arms of every controller in the same way, in MuJoCo."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import coal
import mujoco
import numpy as np
import pinocchio as pin

from arena_robot import ArmModel, corners_of, geoms_of
from q2r2_control.types import Array

TARGET_SPEED, TARGET_TURN_SPEED = 0.3, 1.5  # Speed [m/s] and angular speed [rad/s] of the targets.
ARRIVAL_DISTANCE_M = 0.01  # A tool that is nearer than this to its target has arrived [m].
ARRIVAL_TIMEOUT_S = 0.5  # Longest time that a target at its goal waits for its tool to arrive [s].
_MAX_MEASURED_DISTANCE_M = 0.05  # Distances between the arms are measured only below this [m].
_STEPS_PER_MEASUREMENT = 20  # Number of physics steps from one measurement of the distance to the next.
# If a joint exceeds a limit by less than this, the excess counts as a rounding error. The excess is an angle [rad] for
# a position limit, and a share of the limit for a velocity limit.
_LIMIT_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Ask:
    """Target poses of the tools (world frame) and gripper states. Scripted hands keep them until the tools arrive."""

    tools: Mapping[str, pin.SE3]  # Poses by arm. An arm that is left out keeps its last target.
    closed: tuple[str, ...] = ()  # Arms whose grippers are closed.
    pause: float = 0.0  # Pause after arrival [s].


class ScriptedHands:
    """Targets that move straight from the poses of one :class:`Ask` to the poses of the next, at :data:`TARGET_SPEED`.

    The hands take the next of the ``asks`` only when they need it. Therefore an item may be computed from the state of
    the simulation at that time.
    """

    def __init__(self, asks: Iterator[Ask], tools: Mapping[str, pin.SE3]) -> None:
        self._asks = asks
        self.targets = dict(tools)
        self._ask: Ask | None = next(asks)
        self._waited = self._paused = 0.0

    @property
    def done(self) -> bool:
        return self._ask is None

    @property
    def closed(self) -> tuple[str, ...]:
        return () if self._ask is None else self._ask.closed

    def advance(self, tools: Mapping[str, pin.SE3], dt: float) -> None:
        """Move the targets on by ``dt`` [s]; ``tools`` are the true poses of the tools in the simulation."""
        if self._ask is None:
            return
        goals = {arm: self._ask.tools.get(arm, target) for arm, target in self.targets.items()}
        if all(_moved(self.targets[arm], goals[arm], dt) == 1.0 for arm in goals):
            off = max(float(np.linalg.norm(goals[arm].translation - tools[arm].translation)) for arm in goals)
            self._waited += dt
            if off < ARRIVAL_DISTANCE_M or self._waited > ARRIVAL_TIMEOUT_S:
                self._paused += dt
            if self._paused > self._ask.pause:
                self._ask, self._waited, self._paused = next(self._asks, None), 0.0, 0.0
        for arm, goal in goals.items():
            share = _moved(self.targets[arm], goal, dt)
            self.targets[arm] = goal if share == 1.0 else pin.SE3.Interpolate(self.targets[arm], goal, share)


def _moved(start: pin.SE3, goal: pin.SE3, dt: float) -> float:
    """Return the share of the path from ``start`` to ``goal`` that a target covers in ``dt`` [s]."""
    difference = start.actInv(goal)
    time = max(
        float(np.linalg.norm(difference.translation)) / TARGET_SPEED,
        float(np.linalg.norm(pin.log3(difference.rotation))) / TARGET_TURN_SPEED,
    )
    return min(1.0, dt / max(time, 1e-9))


def looking_down(closing: Array, lean: float = 0.0) -> Array:
    """Return the rotation (3, 3) of a tool whose z axis points down and whose x axis has the direction ``closing``.

    ``closing`` is horizontal. The tool is then turned about its x axis by ``lean`` [rad].
    """
    x = np.array([closing[0], closing[1], 0.0]) / np.hypot(closing[0], closing[1])
    z = np.array([0.0, 0.0, -1.0])
    return pin.exp3(lean * x) @ np.column_stack([x, np.cross(z, x), z])


def shifted(pose: pin.SE3, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> pin.SE3:
    """Return the pose moved along the world's axes [m]."""
    return pin.SE3(pose.rotation, pose.translation + np.array([x, y, z]))


def backed(pose: pin.SE3, way: float) -> pin.SE3:
    """Return ``pose`` moved back along its own z axis by ``way`` [m]."""
    return pose * pin.SE3(np.eye(3), np.array([0.0, 0.0, -way]))


@dataclass
class Judge:
    """The contacts, distances and broken limits of one episode, measured in MuJoCo."""

    model: mujoco.MjModel
    arms: Mapping[str, ArmModel]
    contacts: int = 0  # Number of times that the arms began to touch each other.
    # Least distance between the arms [m]; _MAX_MEASURED_DISTANCE_M if they were always farther apart than this.
    nearest: float = _MAX_MEASURED_DISTANCE_M
    beyond_position: float = 0.0  # Largest angle by which a joint exceeded a position limit [rad].
    velocity_ratio: float = 0.0  # Largest velocity of a joint, divided by its limit.
    _touching: bool = field(default=False, init=False)
    _looks: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        sides = np.zeros(self.model.ngeom, dtype=np.int64)
        first, second = (geoms_of(self.model, arm) for arm in self.arms.values())
        sides[first], sides[second] = 1, -1
        self._sides = sides
        self._pairs = np.array([(a, b) for a in first for b in second])
        self._reach = self.model.geom_rbound[self._pairs].sum(axis=1)
        self._hulls = {geom: _hull(corners_of(self.model, geom)) for geom in [*first, *second]}
        joints = [self.model.joint(name) for arm in self.arms.values() for name in arm.joints]
        self._q = [int(joint.qposadr[0]) for joint in joints]
        self._v = [int(joint.dofadr[0]) for joint in joints]
        self._lower, self._upper = np.array([joint.range for joint in joints]).T
        self._velocity = np.concatenate([arm.velocity_limit for arm in self.arms.values()])

    def look(self, data: mujoco.MjData) -> None:
        """Measure the state after one step of the physics."""
        sides = self._sides[data.contact.geom[: data.ncon]]
        touching = bool((sides[:, 0] * sides[:, 1] < 0).any())
        self.contacts += touching and not self._touching
        self._touching = touching
        q, v = data.qpos[self._q], data.qvel[self._v]
        self.beyond_position = max(self.beyond_position, float(np.maximum(self._lower - q, q - self._upper).max()))
        self.velocity_ratio = max(self.velocity_ratio, float((np.abs(v) / self._velocity).max()))
        if self._looks % _STEPS_PER_MEASUREMENT == 0:
            self._measure(data)
        self._looks += 1

    def _measure(self, data: mujoco.MjData) -> None:
        """Compute distances between the arms with Coal. MuJoCo 3.8 would return 0 for some boxes that are far apart."""
        apart = np.linalg.norm(np.subtract(*data.geom_xpos[self._pairs.T]), axis=1) - self._reach
        for pair in np.argsort(apart):
            if apart[pair] >= self.nearest:
                break
            shapes: list[object] = []
            for geom in self._pairs[pair].tolist():
                pose = coal.Transform3s(data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom])
                shapes += [self._hulls[geom], pose]
            self.nearest = min(self.nearest, coal.distance(*shapes, coal.DistanceRequest(), coal.DistanceResult()))

    @property
    def breaks_position(self) -> bool:
        return self.beyond_position > _LIMIT_TOLERANCE

    @property
    def breaks_velocity(self) -> bool:
        return self.velocity_ratio > 1.0 + _LIMIT_TOLERANCE


def _hull(points: Array) -> coal.ConvexBase:
    mesh = coal.BVHModelOBBRSS()
    mesh.beginModel(0, 0)
    mesh.addVertices(points)
    mesh.endModel()
    mesh.buildConvexHull(True, "Qt")
    return mesh.convex
