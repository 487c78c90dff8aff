"""Tasks beside the tools' targets, by their names in a cell's YAML: joints, look_at, upright, relative.

Each adds  weight |J v - u|^2  with the velocity u that reduces its error at a gain. Tasks that want different things
meet in between, as their weights say; a tool's own are 1 for a metre and 0.09 for a radian. The settings
``position_weights`` and ``rotation_weights`` leave a tool the freedom that such a task needs.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.errors import shown
from q2r2_control.robot.cell_parts import check_position
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_TINY = 1e-9
_SOFT_EDGE = 0.05  # beyond the cone, over which ``upright`` gathers its weight [rad]


class _Cost:
    """H and g of a sum of  weight |J v - u|^2."""

    def __init__(self, nv: int) -> None:
        self.H, self.g = np.zeros((nv, nv)), np.zeros(nv)

    def add(self, J: Array, u: Array, weight: float | Array) -> None:
        """``J`` (k, nv), ``u`` (k,), ``weight`` a number or (k,)."""
        weighted = J.T * weight
        self.H += weighted @ J
        self.g -= weighted @ u


class _Tools:
    """Poses and Jacobians of some tools, in world axes."""

    def __init__(self, robot: Robot, arms: Sequence[str] | None) -> None:
        """Of all arms without ``arms``. Raises :class:`ValueError` for one that is not there."""
        names = list(robot.arms) if arms is None else arms
        if not isinstance(names, list | tuple) or not names or any(name not in [*robot.arms] for name in names):
            raise ValueError(f"arms = {shown(arms)}: allowed: a list of some of {', '.join(robot.arms)}")
        self._model, self._data = robot.model, robot.model.createData()
        self._frames = [robot.arms[name].frame_id for name in names]

    def at(self, q: Array) -> list[tuple[pin.SE3, Array]]:
        """Of each tool its pose, and its Jacobian (6, nv): linear, then angular."""
        pin.computeJointJacobians(self._model, self._data, q)
        return [
            (
                pin.updateFramePlacement(self._model, self._data, frame),
                pin.getFrameJacobian(self._model, self._data, frame, pin.LOCAL_WORLD_ALIGNED),
            )
            for frame in self._frames
        ]


class JointTarget:
    """Joints go to positions of their own within their limits, such as ``{left_A3: 0.3}`` [rad]."""

    def __init__(self, robot: Robot, positions: Mapping[str, float], gain: float = 2.0, weight: float = 0.1) -> None:
        self._gain, self._weight = _positive("gain", gain), _positive("weight", weight)
        if not isinstance(positions, Mapping) or not positions:
            raise ValueError(f"positions = {shown(positions)}: allowed: positions by joint, such as {{left_A3: 0.3}}")
        joints = {joint.get("name", ""): joint for joint in ET.fromstring(robot.urdf).findall("joint")}
        for name, value in positions.items():
            if name not in robot.joint_names:
                raise ValueError(f"positions.{name!s:.40}: no such joint; allowed: {', '.join(robot.joint_names)}")
            if isinstance(value, bool) or not isinstance(value, float | int):
                raise ValueError(f"positions.{name} = {shown(value)}: allowed: a number [rad or m]")
            check_position(joints[name], value, f"control.tasks.joints: positions.{name}")
        self._joints = [robot.joint_names.index(name) for name in positions]
        self._wanted = np.array([float(value) for value in positions.values()])

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """See :class:`Task`."""
        cost = _Cost(len(q))
        cost.add(np.eye(len(q))[self._joints], self._gain * (self._wanted - q[self._joints]), self._weight)
        return cost.H, cost.g


class LookAt:
    """An axis of the tool points at a ``point`` (3,) of the world [m]; the turn about that axis is left free."""

    def __init__(
        self,
        robot: Robot,
        point: Sequence[float],
        arms: Sequence[str] | None = None,
        axis: Sequence[float] = (0.0, 0.0, 1.0),
        gain: float = 4.0,
        weight: float = 0.1,
    ) -> None:
        self._tools, self._axis, self._point = _Tools(robot, arms), _direction("axis", axis), _vector("point", point)
        self._gain, self._weight = _positive("gain", gain), _positive("weight", weight)

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """See :class:`Task`."""
        cost = _Cost(len(q))
        for pose, J in self._tools.at(q):
            pointing, way = pose.rotation @ self._axis, self._point - pose.translation
            distance = max(float(np.linalg.norm(way)), _TINY)
            towards = way / distance
            # The direction to the point turns as well, where the tool moves across it: by towards x d(towards)/dt.
            across = pin.skew(towards) @ J[:3] / -distance
            free = np.eye(3) - np.outer(pointing, pointing)
            cost.add(free @ (J[3:] - across), self._gain * _turn(pointing, towards), self._weight)
        return cost.H, cost.g


class Upright:
    """An axis of the tool stays within ``angle`` [rad] of the direction ``up`` (3,) of the world."""

    def __init__(
        self,
        robot: Robot,
        angle: float,
        arms: Sequence[str] | None = None,
        axis: Sequence[float] = (0.0, 0.0, 1.0),
        up: Sequence[float] = (0.0, 0.0, 1.0),
        gain: float = 4.0,
        weight: float = 10.0,
    ) -> None:
        self._tools, self._axis, self._up = _Tools(robot, arms), _direction("axis", axis), _direction("up", up)
        self._angle, self._gain, self._weight = _positive("angle", angle, math.pi), _positive("gain", gain), weight
        _positive("weight", weight)

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """See :class:`Task`."""
        cost = _Cost(len(q))
        for pose, J in self._tools.at(q):
            back = _turn(pose.rotation @ self._axis, self._up)
            angle = float(np.linalg.norm(back))
            if (beyond := angle - self._angle) > 0.0:
                about = back / angle
                weight = self._weight * min(beyond / _SOFT_EDGE, 1.0)
                cost.add(about[None, :] @ J[3:], np.array([self._gain * beyond]), weight)
        return cost.H, cost.g


class RelativePose:
    """The right tool stays where it is at home in the left tool's frame, or at ``position`` and ``rpy`` there."""

    def __init__(
        self,
        robot: Robot,
        position: Sequence[float] | None = None,
        rpy: Sequence[float] | None = None,
        gain: float = 4.0,
        weight: float = 10.0,
    ) -> None:
        """``position`` (3,) [m], ``rpy`` (3,) [rad]. Raises :class:`ValueError` for a cell of one arm too."""
        self._tools = _Tools(robot, ("left", "right"))
        self._gain, self._weight = _positive("gain", gain), _positive("weight", weight)
        self._wanted = robot.tool_pose(robot.home, "left").actInv(robot.tool_pose(robot.home, "right"))
        if position is not None:
            self._wanted.translation = _vector("position", position)
        if rpy is not None:
            self._wanted.rotation = pin.rpy.rpyToMatrix(*_vector("rpy", rpy))
        self._weights = self._weight * np.array([1.0] * 3 + [ROTATION_LENGTH**2] * 3)

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """See :class:`Task`."""
        cost = _Cost(len(q))
        (left, J_left), (right, J_right) = self._tools.at(q)
        wanted, arm = left * self._wanted, left.rotation @ self._wanted.translation
        error = np.concatenate([wanted.translation - right.translation, pin.log3(wanted.rotation @ right.rotation.T)])
        carried = J_left.copy()
        carried[:3] -= pin.skew(arm) @ J_left[3:]
        cost.add(J_right - carried, self._gain * error, self._weights)
        return cost.H, cost.g


def _turn(of: Array, to: Array) -> Array:
    """Shortest rotation vector (3,) [rad] from one unit vector to another; about any axis where they are opposite."""
    across = np.cross(of, to)
    sine = float(np.linalg.norm(across))
    if sine < _TINY:
        return np.zeros(3) if of @ to > 0.0 else math.pi * np.eye(3)[np.argmin(np.abs(of))]
    return math.atan2(sine, float(of @ to)) / sine * across


def _positive(key: str, value: float, most: float = math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, float | int) or not (0.0 < value <= most and value < math.inf):
        up_to = "" if most == math.inf else f", at most {most:.2f} rad"
        raise ValueError(f"{key} = {value!r:.40}: allowed: a number above 0{up_to}")
    return float(value)


def _vector(key: str, value: Sequence[float]) -> Array:
    try:
        vector = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{key} = {value!s:.60}: allowed: three numbers")
    return vector


def _direction(key: str, value: Sequence[float]) -> Array:
    vector = _vector(key, value)
    if (length := float(np.linalg.norm(vector))) < _TINY:
        raise ValueError(f"{key} = {value!s:.60}: allowed: three numbers, not all 0")
    return vector / length
