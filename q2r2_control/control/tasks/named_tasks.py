"""Tasks that a cell's YAML adds to the tools' targets by name: joints, look_at, upright, relative.

Each task adds the cost  weight |J v - u|^2,  where the velocity u is a gain times the task's error. Tasks with
different goals reach a compromise according to their weights. A tool's target has the weight 1 for metres and 0.09 for
radians. With small values in ``position_weights`` and ``rotation_weights``, a tool has the freedom that such a task
needs.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

import numpy as np
import pinocchio as pin

from q2r2_control.control.tasks.arguments import check_robot, chosen_arms, direction, positive, vector
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.errors import ConfigError, shown
from q2r2_control.robot.cell_parts import check_position
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_TINY = 1e-9
_SOFT_EDGE = 0.05  # Angle beyond the cone at which the weight of ``upright`` has its full value [rad].


class _Cost:
    """Computes H and g of the cost ``weight |J v - u|^2``, summed over the rows of J."""

    def __init__(self, nv: int) -> None:
        self.H, self.g = np.zeros((nv, nv)), np.zeros(nv)

    def add(self, J: Array, u: Array, weight: float | Array) -> None:
        """Add a term with ``J`` (k, nv), ``u`` (k,) and a ``weight`` that is a number or (k,)."""
        weighted = J.T * weight
        self.H += weighted @ J
        self.g -= weighted @ u


class _Tools:
    """Poses and Jacobians of some tools, in world axes."""

    def __init__(self, robot: Robot, arms: Sequence[str] | None) -> None:
        """Take the tools of ``arms``, or all tools if ``arms`` is None.

        Raises :class:`ConfigError` if ``robot`` is not a Robot, or if a name is not the name of an arm.
        """
        check_robot(robot)
        names = chosen_arms(robot, arms)
        self._model, self._data = robot.model, robot.model.createData()
        self._frames = [robot.arms[name].frame_id for name in names]

    def at(self, q: Array) -> list[tuple[pin.SE3, Array]]:
        """Return the pose of each tool, and its Jacobian (6, nv): linear, then angular."""
        pin.computeJointJacobians(self._model, self._data, q)
        return [
            (
                pin.updateFramePlacement(self._model, self._data, frame),
                pin.getFrameJacobian(self._model, self._data, frame, pin.LOCAL_WORLD_ALIGNED),
            )
            for frame in self._frames
        ]


class JointTarget:
    """Moves joints to wanted positions within their limits. Each joint has the cost w |v_j - k (q*_j - q_j)|^2.

    A YAML names the task ``joints``.

    Args:
        robot: The robot with these joints.
        positions: Wanted position q* by the joint's name, such as ``{"left_A3": 0.3}`` [rad, or m of a sliding joint].
        gain: The gain k: speed per distance [1/s].
        weight: The weight w, compared with 1 for a tool's error in metres.

    Raises:
        ConfigError: If a joint does not exist, if a position is outside the joint's limits, or if ``gain`` or
            ``weight`` is not above 0.
    """

    def __init__(self, robot: Robot, positions: Mapping[str, float], gain: float = 2.0, weight: float = 0.1) -> None:
        check_robot(robot)
        self._gain, self._weight = positive("gain", gain), positive("weight", weight)
        if not isinstance(positions, Mapping) or not positions:
            raise ConfigError(f"positions = {shown(positions)}: allowed: positions by joint, such as {{left_A3: 0.3}}")
        joints = {joint.get("name", ""): joint for joint in ET.fromstring(robot.urdf).findall("joint")}
        for name, value in positions.items():
            if name not in robot.joint_names:
                raise ConfigError(f"positions.{name!s:.40}: no such joint; allowed: {', '.join(robot.joint_names)}")
            if isinstance(value, bool) or not isinstance(value, float | int):
                raise ConfigError(f"positions.{name} = {shown(value)}: allowed: a number [rad or m]")
            check_position(joints[name], value, f"positions.{name}")
        self._joints = [robot.joint_names.index(name) for name in positions]
        self._wanted = np.array([float(value) for value in positions.values()])

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """See :meth:`Task.cost`."""
        cost = _Cost(len(q))
        cost.add(np.eye(len(q))[self._joints], self._gain * (self._wanted - q[self._joints]), self._weight)
        return cost.H, cost.g


class LookAt:
    """Lets an axis of the tool point at a point of the world. The rotation about that axis is free.

    Let a be the axis, d the unit vector from the tool to the point, and r the distance of tool and point. Let t be the
    angle from a to d about the unit vector n = a x d / sin t. The cost is  w |(I - a a') (omega - dd) - k t n|^2.  Here
    omega is the angular velocity of the tool. The angular velocity of d is  dd = -d x v / r  while the tool moves with
    the velocity v. A YAML names the task ``look_at``.

    Args:
        robot: The robot with the tools.
        point: The point in the world (3,) [m].
        arms: Names of the arms that have the task; None for all.
        axis: The axis a in the tool's frame (3,), of any length.
        gain: The gain k: angular speed per angle [1/s].
        weight: The weight w, compared with 0.09 for a tool's own rotation.

    Raises:
        ConfigError: If an arm does not exist, or if a number is not allowed.
    """

    def __init__(
        self,
        robot: Robot,
        point: Sequence[float],
        arms: Sequence[str] | None = None,
        axis: Sequence[float] = (0.0, 0.0, 1.0),
        gain: float = 4.0,
        weight: float = 0.1,
    ) -> None:
        self._tools, self._axis, self._point = _Tools(robot, arms), direction("axis", axis), vector("point", point)
        self._gain, self._weight = positive("gain", gain), positive("weight", weight)

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """See :meth:`Task.cost`."""
        cost = _Cost(len(q))
        for pose, J in self._tools.at(q):
            pointing, way = pose.rotation @ self._axis, self._point - pose.translation
            distance = max(float(np.linalg.norm(way)), _TINY)
            towards = way / distance
            # The direction to the point turns too if the tool moves across this direction. Its angular velocity is
            # towards x d(towards)/dt.
            across = pin.skew(towards) @ J[:3] / -distance
            free = np.eye(3) - np.outer(pointing, pointing)
            cost.add(free @ (J[3:] - across), self._gain * _turn(pointing, towards), self._weight)
        return cost.H, cost.g


class Upright:
    """Keeps an axis of the tool within a cone about a direction of the world.

    Within the cone the cost is 0. At an angle t beyond its edge the cost is  w(t) (n' omega - k t)^2.  Here n is the
    axis of the shortest rotation back into the cone, and omega is the angular velocity of the tool. The weight w(t)
    grows from 0 to w over the first 0.05 rad. A YAML names the task ``upright``.

    Args:
        robot: The robot with the tools.
        angle: Angle from the middle of the cone to its edge, up to pi [rad].
        arms: Names of the arms that have the task; None for all.
        axis: The axis in the tool's frame (3,), of any length.
        up: The direction of the cone's middle in the world frame (3,), of any length.
        gain: The gain k: angular speed per angle [1/s].
        weight: The weight w, compared with 0.09 for a tool's own rotation.

    Raises:
        ConfigError: If an arm does not exist, or if a number is not allowed.
    """

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
        self._tools, self._axis, self._up = _Tools(robot, arms), direction("axis", axis), direction("up", up)
        self._angle, self._gain, self._weight = positive("angle", angle, math.pi), positive("gain", gain), weight
        positive("weight", weight)

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """See :meth:`Task.cost`."""
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
    """Lets the right tool keep its pose in the left tool's frame.

    The cost is  w |J_r v - J_c v - k e|^2  with the pose error e of the right tool (6,) and the Jacobian J_r of that
    tool. J_c is the Jacobian of a body that is fixed to the left tool, at the wanted pose of the right tool. A radian
    counts 0.09 times as much as a metre. A YAML names the task ``relative``.

    Args:
        robot: A robot with the arms ``left`` and ``right``.
        position: Position of the right tool in the left tool's frame (3,) [m]; None for the position at home.
        rpy: Roll, pitch and yaw of the right tool in the left tool's frame (3,) [rad]; None for the rotation at home.
        gain: The gain k: speed per distance [1/s].
        weight: The weight w, compared with 1 for a tool's error in metres.

    Raises:
        ConfigError: If the robot does not have both arms, or if a number is not allowed.
    """

    def __init__(
        self,
        robot: Robot,
        position: Sequence[float] | None = None,
        rpy: Sequence[float] | None = None,
        gain: float = 4.0,
        weight: float = 10.0,
    ) -> None:
        self._tools = _Tools(robot, ("left", "right"))
        self._gain, self._weight = positive("gain", gain), positive("weight", weight)
        self._wanted = robot.tool_pose(robot.home, "left").actInv(robot.tool_pose(robot.home, "right"))
        if position is not None:
            self._wanted.translation = vector("position", position)
        if rpy is not None:
            self._wanted.rotation = pin.rpy.rpyToMatrix(*vector("rpy", rpy))
        self._weights = self._weight * np.array([1.0] * 3 + [ROTATION_LENGTH**2] * 3)

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """See :meth:`Task.cost`."""
        cost = _Cost(len(q))
        (left, J_left), (right, J_right) = self._tools.at(q)
        wanted, arm = left * self._wanted, left.rotation @ self._wanted.translation
        error = np.concatenate([wanted.translation - right.translation, pin.log3(wanted.rotation @ right.rotation.T)])
        carried = J_left.copy()
        carried[:3] -= pin.skew(arm) @ J_left[3:]
        cost.add(J_right - carried, self._gain * error, self._weights)
        return cost.H, cost.g


def _turn(of: Array, to: Array) -> Array:
    """Return the shortest rotation vector (3,) [rad] that turns the unit vector ``of`` into the unit vector ``to``.

    If the two vectors are opposite, one of the possible axes is taken.
    """
    across = np.cross(of, to)
    sine = float(np.linalg.norm(across))
    if sine < _TINY:
        return np.zeros(3) if of @ to > 0.0 else math.pi * np.eye(3)[np.argmin(np.abs(of))]
    return math.atan2(sine, float(of @ to)) / sine * across
