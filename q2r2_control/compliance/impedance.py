"""Cartesian impedance control: the QP's reference in, joint torques out that make each tool a damped spring about it.

    tau = J' (K e + D e') + N (K_n (q_r - q) + D_n (v_r - v)) + M(q) a_r + C(q, v) v + g(q) + joint-limit repulsion

e is the way from the measured tool to that of the reference, e' the difference of their twists, D and D_n the damping
of :func:`damp`, N a nullspace projector. Hogan 1985, Albu-Schaeffer et al. 2003.

**Feed-forward M a_r.** Seen from the tool an arm weighs what its rotors weigh geared up, 20 to 140 kg for a robot of
22 kg. Without feed-forward the spring would have to give the force for every acceleration and would have to yield for
it, 30 mm at 1 m/s^2; with it the spring bears only what the model does not know, and may be soft. It vanishes with the
reference's acceleration, so that it does nothing to the stiffness that a push at rest feels.

**Torque rate.** A full stop at 10 rad/s^2 takes 70 Nm more in a joint that moves the whole arm. As long as the torque
rises to that the tool leaves the reference, and with it the distances that the reference keeps.

**Payload.** What grippers hold is part of M, C and g while they do. Its mass comes and goes on a straight line over
0.3 s, so that no torque jumps.

**Time.** A reference is due at the end of its tick, the state is measured at its start. So the spring is about the
reference of the tick before, which is due now, while the acceleration is the one that leads to the newest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from pydantic import ValidationError

from q2r2_control.compliance.impedance_law import (
    BoolArray,
    PositionLimits,
    ToolMotions,
    bound_torque,
    clip_errors,
    limit_repulsion,
    plausible,
    springs_torque,
)
from q2r2_control.config.control import LIVE_IMPEDANCE, ImpedanceSettings
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import LONGEST_DT, Array, Reference, RobotState

_PAYLOAD_TIME = 0.3  # over which a payload's mass comes or goes [s]


@dataclass(slots=True)  # not frozen: that would cost a microsecond a tick
class ImpedanceReport:
    """What one tick did and why. Joints and arms by name."""

    errors: dict[str, Array]  # arm -> (6,) way to the reference after clipping [m, rad], world axes
    clipped: tuple[str, ...]  # arms that are further from their reference than the clip allows
    saturated: tuple[str, ...]  # joints that would need more than their torque limit
    rate_limited: tuple[str, ...]  # joints whose torque could not change as fast as it should
    repelled: tuple[str, ...]  # joints that are pushed away from a position limit
    held: bool  # the measured state was of no use: the last gravity torque is held


@dataclass(slots=True)
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
        self._arms = tuple(robot.arms)
        self._limit = self.settings.torque_scale * robot.torque_limit
        self._payloads = {arm: held for arm, held in robot.objects.by_arm.items() if held.config.mass > 0.0}
        self._borne = dict.fromkeys(self._payloads, 0.0)  # share of each payload's mass
        self._wanted_borne = dict(self._borne)
        self._frames = [arm.frame_id for arm in robot.arms.values()]
        self._position_limits = PositionLimits(
            lower=robot.position_lower,
            upper=robot.position_upper,
            stiffness=self.settings.limit_stiffness,
            damping=self.settings.limit_damping,
            distance=self.settings.limit_distance,
        )
        # A copy, to which payloads are added, with what is computed of the measured and of the wanted posture.
        self._model = robot.model.copy()
        self._measured, self._wanted = self._model.createData(), self._model.createData()
        k, nv = len(self._arms), self._model.nv
        member = np.array([np.isin(np.arange(nv), arm.joints) for arm in robot.arms.values()], dtype=np.float64)
        self._tools = ToolMotions(np.zeros((k, 6, nv)), np.zeros((k, 6)), np.zeros((k, 6)), member)
        self._clipped = np.zeros(k, dtype=np.bool_)
        values = [float(getattr(self.settings, name)) for name in LIVE_IMPEDANCE]
        self._springs = np.tile(values, (len(self._arms), 1))  # in force
        self._wanted_springs = self._springs.copy()  # at the end of a ramp
        self._ramp_rate = np.zeros_like(self._springs)
        self._ramping = False
        self._begin(robot.home)

    def reset(self, state: RobotState) -> None:
        """Start anew at rest at the measured posture: the first torque is that of gravity there, without a bump.

        Stiffness, damping or a payload that is being changed is reached at once. Raises :class:`RobotError` for a
        posture that is not nv finite numbers.
        """
        q = np.array(state.q, dtype=np.float64)
        if q.shape != self._limit.shape or not np.isfinite(q).all():
            raise RobotError(f"impedance reset: q = {q!s:.80}: expected {len(self._limit)} finite numbers")
        self._springs[:] = self._wanted_springs
        self._ramping = False
        if self._borne != self._wanted_borne:
            self._bear(1.0)
        self._begin(q)

    def _begin(self, q: Array) -> None:
        self._due = (q.copy(), np.zeros_like(q))  # posture and speed of the reference that is due now
        self._usable_q = q.copy()  # the newest measured posture that was of use
        self._commanded: Array = np.minimum(np.maximum(self.gravity(q), -self._limit), self._limit)

    def gravity(self, q: Array) -> Array:
        """Torque (nv,) that bears the arms, with what they hold, at a posture ``q`` (nv,) [rad], [Nm]."""
        return np.array(pin.computeGeneralizedGravity(self._model, self._measured, q))

    def set_holding(self, holding: Mapping[str, bool]) -> None:
        """Of each arm whose gripper has an object, whether it is held and its mass to be borne."""
        for arm in self._payloads:
            self._wanted_borne[arm] = float(holding.get(arm, False))

    def _bear(self, change: float) -> None:
        """Let the borne share of each payload come nearer to the wanted one by ``change``."""
        inertias = {held.joint: self.robot.model.inertias[held.joint] for held in self._payloads.values()}
        for arm, held in self._payloads.items():
            way = self._wanted_borne[arm] - self._borne[arm]
            self._borne[arm] += min(max(way, -change), change)
            if self._borne[arm] > 0.0:
                inertias[held.joint] = inertias[held.joint] + held.inertia(self._borne[arm])
        for joint, inertia in inertias.items():
            self._model.inertias[joint] = inertia

    def change(self, values: Mapping[str, float], arm: str | None = None) -> None:
        """Go by other stiffness and damping of one arm or of all, by name as in ``LIVE_IMPEDANCE``.

        On a straight line over ``ramp_time``, and no jump: stiffness is energy in a spring that is stretched. The
        damping follows the stiffness, so that a damping ratio stays that is not changed itself. Raises
        :class:`ConfigError`, and changes nothing, for another name, a value out of range or an arm that does not exist.
        """
        if arm is not None and arm not in self._arms:
            raise ConfigError(f"impedance: no arm {arm!r:.40}; arms: {', '.join(self._arms)}")
        for name, value in values.items():
            if name not in LIVE_IMPEDANCE:
                allowed = ", ".join(LIVE_IMPEDANCE)
                raise ConfigError(f"impedance: {name} = {value!r:.40}: while a controller runs: {allowed}")
        try:
            ImpedanceSettings.model_validate(dict(values), strict=True)
        except ValidationError as error:
            fault = error.errors()[0]
            raise ConfigError(f"{fault['loc'][0]} = {fault['input']!r:.40}: {fault['msg']}") from error
        changed = slice(None) if arm is None else self._arms.index(arm)
        for name, value in values.items():
            column = LIVE_IMPEDANCE.index(name)
            self._wanted_springs[changed, column] = value
            way = self._wanted_springs[changed, column] - self._springs[changed, column]
            self._ramp_rate[changed, column] = np.abs(way) / self.settings.ramp_time
        self._ramping = True

    def in_force(self, arm: str) -> dict[str, float]:
        """What of ``LIVE_IMPEDANCE`` an arm goes by now."""
        return dict(zip(LIVE_IMPEDANCE, self._springs[self._arms.index(arm)].tolist(), strict=True))

    def step(self, reference: Reference, state: RobotState, dt: float, extra: Array | None = None) -> TorqueCommand:
        """Torques for a tick of ``dt`` [s] that begins at ``state`` and ends when ``reference`` is due.

        ``extra`` (nv,) [Nm] is added before saturation. A reference that is not finite is not used: the last one is
        held. Where the state, or what comes of it, is not finite, the last gravity torque is held, since a spring
        about an unknown posture could push anywhere. A dt that is not in (0, 0.1] s counts as 0 or as 0.1 s.
        """
        usable = isinstance(dt, int | float | np.floating) and math.isfinite(dt) and dt > 0.0
        time = min(float(dt), LONGEST_DT) if usable else 0.0
        if self._ramping:
            self._ramp(time)
        if self._borne != self._wanted_borne:
            self._bear(time / _PAYLOAD_TIME)
        wanted_q, wanted_v, a = self._next_reference(reference)
        torque = None
        if plausible(state.q, state.v) and (extra is None or plausible(extra)):
            torque = self._law(state.q, state.v, wanted_q, wanted_v, a)
        if torque is None:
            torque, report = self.gravity(self._usable_q), ImpedanceReport({}, (), (), (), (), held=True)
        else:
            self._usable_q = state.q.copy()
            repulsion = limit_repulsion(self._position_limits, state.q, state.v, wanted_q)
            torque = torque + repulsion if extra is None else torque + repulsion + extra
            report = ImpedanceReport(
                errors=dict(zip(self._arms, self._tools.error.copy(), strict=True)),
                clipped=_those(self._arms, self._clipped),
                saturated=(),
                rate_limited=(),
                repelled=_those(self.robot.joint_names, repulsion),
                held=False,
            )
        change = self.settings.torque_rate_limit * time
        self._commanded, saturated, late = bound_torque(torque, self._commanded, self._limit, change)
        report.saturated, report.rate_limited = (_those(self.robot.joint_names, which) for which in (saturated, late))
        return TorqueCommand(self._commanded.copy(), report)

    def _next_reference(self, newest: Reference) -> tuple[Array, Array, Array]:
        """Posture and speed that are due now, and the acceleration that leads to the ``newest``, which is kept."""
        (wanted_q, wanted_v), at_rest = self._due, np.zeros(len(self._limit))
        if not plausible(newest.q, newest.v, newest.a):
            self._due = (wanted_q, at_rest)
            return wanted_q, wanted_v, at_rest
        self._due = (newest.q.copy(), newest.v.copy())
        return wanted_q, wanted_v, newest.a

    def _law(self, q: Array, v: Array, wanted_q: Array, wanted_v: Array, a: Array) -> Array | None:
        """Torque (nv,) of springs, postures and feed-forward, without bounds; None where no number comes of it."""
        model, measured, settings = self._model, self._measured, self.settings
        self._update_tools(q, wanted_q, wanted_v)
        self._clipped = clip_errors(self._tools.error, settings.max_position_error, settings.max_rotation_error)
        M, M_inverse = pin.crba(model, measured, q), pin.computeMinverse(model, measured, q)
        consistent = settings.nullspace_projector == "consistent"
        try:
            springs = springs_torque(
                self._tools, v, wanted_q - q, wanted_v - v, M, M_inverse, self._springs, consistent
            )
        except np.linalg.LinAlgError:
            return None
        tau: Array = pin.rnea(model, measured, q, v, a) + springs
        return tau if np.isfinite(tau).all() else None

    def _update_tools(self, q: Array, wanted_q: Array, wanted_v: Array) -> None:
        """Measured Jacobians, wanted twists, and the ways from measured to wanted poses."""
        model, measured, wanted, tools = self._model, self._measured, self._wanted, self._tools
        pin.computeJointJacobians(model, measured, q)
        pin.forwardKinematics(model, wanted, wanted_q, wanted_v)
        for i, frame in enumerate(self._frames):
            tools.J[i] = pin.getFrameJacobian(model, measured, frame, pin.LOCAL_WORLD_ALIGNED)
            tools.wanted_twist[i] = pin.getFrameVelocity(model, wanted, frame, pin.LOCAL_WORLD_ALIGNED).vector
            here = pin.updateFramePlacement(model, measured, frame)
            there = pin.updateFramePlacement(model, wanted, frame)
            tools.error[i, :3] = there.translation - here.translation
            tools.error[i, 3:] = pin.log3(there.rotation @ here.rotation.T)

    def _ramp(self, time: float) -> None:
        reach, springs = self._ramp_rate * time, self._springs
        springs[:] += np.minimum(np.maximum(self._wanted_springs - springs, -reach), reach)
        self._ramping = bool((springs != self._wanted_springs).any())


def _those(names: tuple[str, ...], which: BoolArray | Array) -> tuple[str, ...]:
    """The names at which ``which`` is not 0."""
    return tuple(names[index] for index in np.flatnonzero(which)) if which.any() else ()
