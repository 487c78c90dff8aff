"""Cartesian impedance control: the QP's reference in, joint torques out that make each tool a damped spring about it.

    tau = J' (K e + D e') + N (K_n (q_r - q) + D_n (v_r - v)) + M(q) a_r + C(q, v) v + g(q) + joint-limit repulsion

e is the way from the measured tool to that of the reference, e' the difference of their twists, D and D_n the damping
of :func:`double_diagonalised_damping`, N a nullspace projector. Hogan 1985, Albu-Schaeffer et al. 2003.

**Feed-forward M a_r.** Seen from the tool an arm weighs what its rotors weigh geared up, 20 to 140 kg for a robot of
22 kg. Without feed-forward the spring would have to give the force for every acceleration and would have to yield for
it, 30 mm at 1 m/s^2; with it the spring bears only what the model does not know, and may be soft. It vanishes with the
reference's acceleration, so that it does nothing to the stiffness that a push at rest feels.

**Torque rate.** A full stop at 10 rad/s^2 takes 70 Nm more in a joint that moves the whole arm. As long as the torque
rises to that the tool leaves the reference, and with it the distances that the reference keeps.

**Time.** A reference is due at the end of its tick, the state is measured at its start. So the spring is about the
reference of the tick before, which is due now, while the acceleration is the one that leads to the newest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from pydantic import ValidationError

from q2r2_control.control.compliance import (
    BoolArray,
    bound_torque,
    clip_error,
    consistent_projector,
    double_diagonalised_damping,
    kinematic_projector,
    limit_repulsion,
    pose_error,
    task_inertia,
)
from q2r2_control.control.controller import LONGEST_DT
from q2r2_control.control.settings import ImpedanceSettings
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.robot import Arm, Robot
from q2r2_control.types import Array, Reference, RobotState


@dataclass(frozen=True, slots=True)
class ImpedanceReport:
    """What one tick did and why. Joints and arms by name."""

    errors: dict[str, Array]  # arm -> (6,) way to the reference after clipping [m, rad], world axes
    clipped: tuple[str, ...]  # arms that are further from their reference than the clip allows
    saturated: tuple[str, ...]  # joints that would need more than their torque limit
    rate_limited: tuple[str, ...]  # joints whose torque could not change as fast as it should
    repelled: tuple[str, ...]  # joints that are pushed away from a position limit
    held: bool  # the measured state was of no use: the last gravity torque is held


@dataclass(frozen=True, slots=True)
class TorqueCommand:
    """Joint torques of one tick."""

    tau: Array  # (nv,) [Nm]
    report: ImpedanceReport


class ImpedanceController:
    """Turns each tick's reference and measured state into joint torques, for all arms of a cell.

    At every tick, whatever comes in: finite torques, within ``torque_scale`` of the robot's limits, and no further from
    the tick before than ``torque_rate_limit`` allows. Each arm is treated by itself, with its own blocks of the inertia
    matrix and its inverse; joints that several arms hang on get the sum.
    """

    def __init__(self, robot: Robot, settings: ImpedanceSettings | None = None) -> None:
        self.robot = robot
        self.settings = settings or ImpedanceSettings()
        self._limit = self.settings.torque_scale * robot.torque_limit
        self._data, self._wanted_data = robot.model.createData(), robot.model.createData()
        stiffness = np.array([self.settings.translational_stiffness, self.settings.rotational_stiffness])
        self._stiffness = {arm: stiffness.copy() for arm in robot.arms}  # [N/m, Nm/rad], on its way to the goal
        self._goal = {arm: stiffness.copy() for arm in robot.arms}
        self._ramp_rate = {arm: np.zeros(2) for arm in robot.arms}
        self._begin(robot.home, np.zeros(robot.model.nv))

    def reset(self, state: RobotState) -> None:
        """Start anew at rest at the measured posture: the first torque is that of gravity there, without a bump.

        A stiffness that is being changed is reached at once. Raises :class:`RobotError` for a posture that is not nv
        finite numbers.
        """
        q = np.array(state.q, dtype=np.float64)
        if q.shape != self._limit.shape or not np.isfinite(q).all():
            raise RobotError(f"impedance reset: q = {q!s:.80}: expected {len(self._limit)} finite numbers")
        for arm, goal in self._goal.items():
            self._stiffness[arm] = goal.copy()
        self._begin(q, np.zeros_like(q))

    def _begin(self, q: Array, v: Array) -> None:
        self._due_q, self._due_v = q.copy(), v  # of the newest reference, due at the end of its tick
        self._wanted_q, self._wanted_v = self._due_q, self._due_v  # of the one before, due now
        self._gravity = np.array(pin.computeGeneralizedGravity(self.robot.model, self._data, q))
        self._last = np.minimum(np.maximum(self._gravity, -self._limit), self._limit)

    def set_stiffness(
        self, translational: float | None = None, rotational: float | None = None, arm: str | None = None
    ) -> None:
        """Change the stiffness [N/m], [Nm/rad] of one arm or of all, on a straight line over ``ramp_time``.

        The damping follows, so that the damping ratio stays. A ramp and no jump: stiffness is energy in a spring that
        is stretched. Raises :class:`ConfigError` for a value out of range or an arm that does not exist.
        """
        if arm is not None and arm not in self._goal:
            raise ConfigError(f"stiffness: no arm {arm!r:.40}; arms: {', '.join(self._goal)}")
        given = {"translational_stiffness": translational, "rotational_stiffness": rotational}
        changes = {key: value for key, value in given.items() if value is not None}
        try:
            ImpedanceSettings.model_validate(changes, strict=True)
        except ValidationError as error:
            fault = error.errors()[0]
            raise ConfigError(f"{fault['loc'][0]} = {fault['input']!r:.40}: {fault['msg']}") from error
        for name in self._goal if arm is None else (arm,):
            wanted = (translational, rotational)
            self._goal[name] = np.array([g if w is None else w for g, w in zip(self._goal[name], wanted, strict=True)])
            self._ramp_rate[name] = np.abs(self._goal[name] - self._stiffness[name]) / self.settings.ramp_time

    def stiffness(self, arm: str) -> tuple[float, float]:
        """Stiffness of an arm's tool in force now: translational [N/m], rotational [Nm/rad]."""
        translational, rotational = self._stiffness[arm]
        return float(translational), float(rotational)

    def step(self, reference: Reference, state: RobotState, dt: float, extra: Array | None = None) -> TorqueCommand:
        """Torques for a tick of ``dt`` [s] that begins at ``state`` and ends when ``reference`` is due.

        ``extra`` (nv,) [Nm] is added before saturation. A reference that is not finite is not used: the last one is
        held. Where the state, or what comes of it, is not finite, the last gravity torque is held, since a spring
        about an unknown posture could push anywhere. A dt that is not in (0, 0.1] s counts as 0 or as 0.1 s.
        """
        usable = isinstance(dt, int | float | np.floating) and math.isfinite(dt) and dt > 0.0
        time = min(float(dt), LONGEST_DT) if usable else 0.0
        self._ramp(time)
        acceleration = self._exchange(reference)
        law = self._law(state, acceleration) if _finite(state.q, state.v) else None
        wanted = self._gravity
        if law is not None:
            wanted = law.tau if extra is None else law.tau + extra
            if _finite(wanted):
                self._gravity = law.gravity
            else:
                law, wanted = None, self._gravity
        bounded = bound_torque(wanted, self._last, self._limit, self.settings.torque_rate_limit * time)
        self._last = bounded.tau
        report = ImpedanceReport(
            errors={} if law is None else law.errors,
            clipped=() if law is None else law.clipped,
            saturated=self._names(bounded.saturated),
            rate_limited=self._names(bounded.rate_limited),
            repelled=() if law is None else self._names(law.repulsion != 0.0),
            held=law is None,
        )
        return TorqueCommand(bounded.tau.copy(), report)

    def _ramp(self, time: float) -> None:
        for arm, goal in self._goal.items():
            reach = self._ramp_rate[arm] * time
            self._stiffness[arm] += np.minimum(np.maximum(goal - self._stiffness[arm], -reach), reach)

    def _exchange(self, reference: Reference) -> Array:
        """Take the newest reference in for the next tick; returns the acceleration (nv,) that leads to it."""
        self._wanted_q, self._wanted_v = self._due_q, self._due_v
        if _finite(reference.q, reference.v, reference.a):
            self._due_q, self._due_v = reference.q.copy(), reference.v.copy()
            return reference.a
        self._due_v = np.zeros_like(self._due_v)
        return self._due_v

    def _law(self, state: RobotState, acceleration: Array) -> _Law | None:
        """The control law, without bounds; None where the numbers are too large to be computed with."""
        model, data, settings = self.robot.model, self._data, self.settings
        gravity = np.array(pin.computeGeneralizedGravity(model, data, state.q))
        repulsion = limit_repulsion(
            state.q,
            state.v,
            self._wanted_q,
            self.robot.position_lower,
            self.robot.position_upper,
            settings.limit_stiffness,
            settings.limit_damping,
            settings.limit_distance,
        )
        tau = repulsion + pin.rnea(model, data, state.q, state.v, acceleration)
        inertia = np.array(pin.crba(model, data, state.q))
        inverse = np.array(pin.computeMinverse(model, data, state.q))
        pin.computeJointJacobians(model, data, state.q)
        pin.computeJointJacobians(model, self._wanted_data, self._wanted_q)
        errors, clipped = {}, []
        try:
            for name, arm in self.robot.arms.items():
                torque, errors[name], was_clipped = self._arm_torque(arm, state, inertia, inverse)
                tau[arm.joints] += torque
                if was_clipped:
                    clipped.append(name)
        except np.linalg.LinAlgError:
            return None
        return _Law(tau, gravity, repulsion, errors, tuple(clipped))

    def _arm_torque(self, arm: Arm, state: RobotState, inertia: Array, inverse: Array) -> tuple[Array, Array, bool]:
        """Torque (n,) of one arm's spring and posture, its clipped error (6,), and whether that was clipped."""
        model, settings, joints = self.robot.model, self.settings, arm.joints
        frame = arm.frame_id
        pose = pin.updateFramePlacement(model, self._data, frame)
        goal = pin.updateFramePlacement(model, self._wanted_data, frame)
        J = pin.getFrameJacobian(model, self._data, frame, pin.LOCAL_WORLD_ALIGNED)[:, joints]
        J_goal = pin.getFrameJacobian(model, self._wanted_data, frame, pin.LOCAL_WORLD_ALIGNED)[:, joints]
        error, clipped = clip_error(pose_error(goal, pose), settings.max_position_error, settings.max_rotation_error)
        error_rate = J_goal @ self._wanted_v[joints] - J @ state.v[joints]
        block = np.ix_(joints, joints)
        M, M_inverse = inertia[block], inverse[block]
        tool_inertia = task_inertia(J, M_inverse)
        stiffness = np.repeat(self._stiffness[arm.name], 3)
        damping = double_diagonalised_damping(stiffness, tool_inertia, settings.damping_ratio)
        posture_stiffness = np.full(len(joints), settings.nullspace_stiffness)
        posture_damping = double_diagonalised_damping(posture_stiffness, M, settings.nullspace_damping_ratio)
        posture: Array = posture_stiffness * (self._wanted_q - state.q)[joints]
        posture += posture_damping @ (self._wanted_v - state.v)[joints]
        if settings.nullspace_projector == "consistent":
            N = consistent_projector(J, M_inverse, tool_inertia)
        else:
            N = kinematic_projector(J)
        torque: Array = J.T @ (stiffness * error + damping @ error_rate) + N @ posture
        return torque, error, clipped

    def _names(self, which: BoolArray) -> tuple[str, ...]:
        if not which.any():
            return ()
        return tuple(self.robot.joint_names[index] for index in np.flatnonzero(which))


@dataclass(frozen=True, slots=True)
class _Law:
    tau: Array  # (nv,) [Nm]
    gravity: Array  # (nv,) [Nm]
    repulsion: Array  # (nv,) [Nm]
    errors: dict[str, Array]
    clipped: tuple[str, ...]


def _finite(*arrays: Array) -> bool:
    return all(np.isfinite(array).all() for array in arrays)
