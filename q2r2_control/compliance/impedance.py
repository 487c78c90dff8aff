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
from pydantic import ValidationError

from q2r2_control.compliance.impedance_data import ImpedanceData, ImpedanceModel
from q2r2_control.compliance.impedance_kernels import (
    BOUNDED,
    CLIPPED,
    HELD,
    REPELLED,
    gravity_torque,
    impedance_torque,
)
from q2r2_control.compliance.impedance_terms import BoolArray, PositionLimits
from q2r2_control.compliance.joint_dynamics import LinkInertias
from q2r2_control.config.control import LIVE_IMPEDANCE, ImpedanceSettings
from q2r2_control.control.geometry.kinematics import IntArray, chain_of
from q2r2_control.control.jit import bound, hold
from q2r2_control.control.tasks.task_model import tools_of
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
        model = _model_of(robot, self.settings)
        self._bodies, self._data = model.bodies, ImpedanceData.empty(model)
        self._inputs = self._data.inputs.reshape(-1)  # a view
        self._held_model, self._held_data = hold(model), hold(self._data)
        self._data.springs[:] = [getattr(self.settings, name) for name in LIVE_IMPEDANCE]
        self._wanted_springs = self._data.springs.copy()  # at the end of a ramp
        self._ramp_rate = np.zeros_like(self._wanted_springs)
        self._ramping = False
        # Every kernel runs once here, so that none is compiled in mid-motion.
        self._gravity_torque = bound(gravity_torque, self._held_model, self._held_data)
        self._impedance_torque = bound(impedance_torque, self._held_model, self._held_data, 0.0)
        self._begin(robot.home)

    def reset(self, state: RobotState) -> None:
        """Start anew at rest at the measured posture: the first torque is that of gravity there, without a bump.

        Stiffness, damping or a payload that is being changed is reached at once. Raises :class:`RobotError` for a
        posture that is not nv finite numbers.
        """
        q = np.array(state.q, dtype=np.float64)
        if q.shape != self._limit.shape or not np.isfinite(q).all():
            raise RobotError(f"impedance reset: q = {q!s:.80}: expected {len(self._limit)} finite numbers")
        self._data.springs[:] = self._wanted_springs
        self._ramping = False
        if self._borne != self._wanted_borne:
            self._bear(1.0)
        self._begin(q)

    def _begin(self, q: Array) -> None:
        data = self._data
        data.references.due_q[:], data.references.due_v[:] = q, 0.0
        data.usable_q[:] = q
        data.bounded[:] = np.minimum(np.maximum(self.gravity(q), -self._limit), self._limit)

    def gravity(self, q: Array) -> Array:
        """Torque (nv,) that bears the arms, with what they hold, at a posture ``q`` (nv,) [rad], [Nm]."""
        data = self._data
        usable, data.usable_q[:] = data.usable_q.copy(), q
        self._gravity_torque(self._held_model, self._held_data)
        data.usable_q[:] = usable
        return data.tau.copy()

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
            self._bodies.put(joint, inertia)

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
            way = self._wanted_springs[changed, column] - self._data.springs[changed, column]
            self._ramp_rate[changed, column] = np.abs(way) / self.settings.ramp_time
        self._ramping = True

    def in_force(self, arm: str) -> dict[str, float]:
        """What of ``LIVE_IMPEDANCE`` an arm goes by now."""
        return dict(zip(LIVE_IMPEDANCE, self._data.springs[self._arms.index(arm)].tolist(), strict=True))

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
        data = self._data
        added = data.no_motion if extra is None else extra
        np.concatenate((state.q, state.v, reference.q, reference.v, reference.a, added), out=self._inputs)
        change = self.settings.torque_rate_limit * time
        found = self._impedance_torque(self._held_model, self._held_data, change)
        held, joints = bool(found & HELD), self.robot.joint_names
        report = ImpedanceReport(
            errors={} if held else dict(zip(self._arms, data.errors.copy(), strict=True)),
            clipped=_those(self._arms, data.clipped) if found & CLIPPED else (),
            saturated=_those(joints, data.saturated) if found & BOUNDED else (),
            rate_limited=_those(joints, data.rate_limited) if found & BOUNDED else (),
            repelled=_those(joints, data.repulsion) if found & REPELLED else (),
            held=held,
        )
        return TorqueCommand(data.bounded.copy(), report)

    def _ramp(self, time: float) -> None:
        reach, springs = self._ramp_rate * time, self._data.springs
        springs[:] += np.minimum(np.maximum(self._wanted_springs - springs, -reach), reach)
        self._ramping = bool((springs != self._wanted_springs).any())


def _model_of(robot: Robot, settings: ImpedanceSettings) -> ImpedanceModel:
    arms = list(robot.arms.values())
    joints = np.zeros((len(arms), max(len(arm.joints) for arm in arms)), dtype=np.int64)
    for row, arm in zip(joints, arms, strict=True):
        row[: len(arm.joints)] = arm.joints
    return ImpedanceModel(
        chain=chain_of(robot.model),
        bodies=LinkInertias.of(robot.model),
        tools=tools_of(robot),
        joints=joints,
        dofs=np.array([len(arm.joints) for arm in arms]),
        torque_limit=settings.torque_scale * robot.torque_limit,
        limits=PositionLimits(
            lower=robot.position_lower,
            upper=robot.position_upper,
            stiffness=settings.limit_stiffness,
            damping=settings.limit_damping,
            distance=settings.limit_distance,
        ),
        max_position_error=settings.max_position_error,
        max_rotation_error=settings.max_rotation_error,
        consistent=settings.nullspace_projector == "consistent",
    )


def _those(names: tuple[str, ...], which: IntArray | BoolArray | Array) -> tuple[str, ...]:
    """The names at which ``which`` is not 0."""
    return tuple(names[index] for index in np.flatnonzero(which))
