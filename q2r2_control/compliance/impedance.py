"""Cartesian impedance control: the QP's reference in, joint torques out that make each tool a damped spring about it.

    tau = J' (K e + D e') + N (K_n (q_r - q) + D_n (v_r - v)) + M(q) a_r + C(q, v) v + g(q) + joint-limit repulsion

e is the way from the measured tool to that of the reference, e' the difference of their twists, D and D_n the damping
of :func:`inertia_and_damping`, N a nullspace projector. Hogan 1985, Albu-Schaeffer et al. 2003.

**Feed-forward M a_r.** Seen from the tool an arm weighs what its rotors weigh geared up, 20 to 140 kg for a robot of 22
kg. Without feed-forward the spring would have to yield for every acceleration, 30 mm at 1 m/s^2. With it the spring
bears only the errors of the model, and may be soft. A push at rest feels none of it.

**Torque rate.** A full stop at 10 rad/s^2 takes 70 Nm more in a joint that moves the whole arm. As long as the torque
rises to that the tool leaves the reference, and with it the distances that the reference keeps.

**Payload.** A held object is part of M, C and g. Its mass comes and goes on a straight line over 0.3 s, so that no
torque jumps.

**Time.** A reference is due at the end of its tick, the state is measured at its start. The spring is therefore about
the reference of the tick before, which is due now. The acceleration is the one that leads to the newest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import compress

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.impedance_law import (
    BoolArray,
    ImpedanceData,
    ImpedanceModel,
    PositionLimits,
    bound_torque,
    impedance_torque,
)
from q2r2_control.config.control import LIVE_IMPEDANCE, ImpedanceSettings
from q2r2_control.config.strict import validated
from q2r2_control.control.geometry.kinematics import chain_of
from q2r2_control.control.jit import bound
from q2r2_control.control.kernel_pointers import pointer_to
from q2r2_control.control.tasks.frame import tools_of
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import LONGEST_DT, Array, Reference, RobotState

_PAYLOAD_TIME = 0.3  # over which a payload's mass comes or goes [s]


@dataclass(slots=True)
class ImpedanceReport:
    """Outcome of one tick. Joints and arms by name."""

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
        self.robot, self._arms = robot, tuple(robot.arms)
        self.settings = settings = settings or ImpedanceSettings()
        self._limit = settings.torque_scale * robot.torque_limit
        self._payloads = {arm: held for arm, held in robot.objects.by_arm.items() if held.config.mass > 0.0}
        self._borne = dict.fromkeys(self._payloads, 0.0)  # share of each payload's mass
        self._wanted_borne = dict(self._borne)
        spring = settings.limit_stiffness, settings.limit_damping, settings.limit_distance
        limits = PositionLimits(robot.position_lower, robot.position_upper, *spring)
        largest_error = np.array([settings.max_position_error, settings.max_rotation_error])
        model = ImpedanceModel(chain_of(robot.model), tools_of(robot), limits, self._limit, largest_error)
        values = [float(getattr(settings, name)) for name in LIVE_IMPEDANCE]
        self._springs = np.tile(values, (len(self._arms), 1))  # in force
        self._kernel_data = ImpedanceData.empty(model, self._springs)
        self._inputs = self._kernel_data.inputs.reshape(-1)  # a view
        self._pointers = pointer_to(model), pointer_to(self._kernel_data)
        self._impedance_torque = bound(impedance_torque, *self._pointers, 0.0)
        self._model = robot.model.copy()  # to which payloads are added
        self._pinocchio_data = self._model.createData()
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
        data = self._kernel_data
        data.due[:] = q, np.zeros_like(q)
        self._usable_q = q  # the newest measured posture that was of use
        data.commanded[:] = np.minimum(np.maximum(self.gravity(q), -self._limit), self._limit)

    def gravity(self, q: Array) -> Array:
        """Torque (nv,) that bears the arms, with what they hold, at a posture ``q`` (nv,) [rad], [Nm]."""
        return np.array(pin.computeGeneralizedGravity(self._model, self._pinocchio_data, q))

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

        On a straight line over ``ramp_time``, since stiffness is energy in a spring that is stretched. Raises
        :class:`ConfigError`, and changes nothing, for another name, a value out of range or an arm that does not exist.
        """
        if arm is not None and arm not in self._arms:
            raise ConfigError(f"impedance: no arm {arm!r:.40}; arms: {', '.join(self._arms)}")
        check_springs(values)
        changed = slice(None) if arm is None else self._arms.index(arm)
        for name, value in values.items():
            column = LIVE_IMPEDANCE.index(name)
            self._wanted_springs[changed, column] = value
            way = self._wanted_springs[changed, column] - self._springs[changed, column]
            self._ramp_rate[changed, column] = np.abs(way) / self.settings.ramp_time
        self._ramping = True

    def in_force(self, arm: str) -> dict[str, float]:
        """The part of ``LIVE_IMPEDANCE`` an arm goes by now."""
        return dict(zip(LIVE_IMPEDANCE, self._springs[self._arms.index(arm)].tolist(), strict=True))

    def step(self, reference: Reference, state: RobotState, dt: float, extra: Array | None = None) -> TorqueCommand:
        """Torques for a tick of ``dt`` [s] that begins at ``state`` and ends when ``reference`` is due.

        ``extra`` (nv,) [Nm] is added before saturation. A reference that is not finite is not used: the last one is
        held. The last gravity torque is held where the state, or a result of it, is not finite. A spring about an
        unknown posture could push anywhere. A dt that is not in (0, 0.1] s counts as 0 or as 0.1 s.
        """
        time = min(float(dt), LONGEST_DT) if dt > 0.0 else 0.0
        if self._ramping:
            reach, springs = self._ramp_rate * time, self._springs
            springs[:] += np.minimum(np.maximum(self._wanted_springs - springs, -reach), reach)
            self._ramping = bool((springs != self._wanted_springs).any())
        if self._borne != self._wanted_borne:
            self._bear(time / _PAYLOAD_TIME)
        data, added = self._kernel_data, np.zeros_like(self._limit) if extra is None else extra
        np.concatenate((state.q, state.v, reference.q, reference.v, reference.a, added), out=self._inputs)
        data.torque[:] = pin.nonLinearEffects(self._model, self._pinocchio_data, state.q, state.v)
        data.M[:] = pin.crba(self._model, self._pinocchio_data, state.q)
        change = self.settings.torque_rate_limit * time
        usable, clipped, repelled, held_back = self._impedance_torque(*self._pointers, change)
        if usable:
            self._usable_q = state.q.copy()
            errors = dict(zip(self._arms, data.error.copy(), strict=True))
            report = ImpedanceReport(errors, (), (), (), (), held=False)
        else:
            bounds = bound_torque(self.gravity(self._usable_q), data.commanded, self._limit, change)
            data.commanded[:], data.saturated[:], data.late[:] = bounds
            held_back, report = True, ImpedanceReport({}, (), (), (), (), held=True)
        joints = self.robot.joint_names
        if clipped:
            report.clipped = _those(self._arms, data.clipped)
        if repelled:
            report.repelled = _those(joints, data.repulsion)
        if held_back:
            report.saturated, report.rate_limited = _those(joints, data.saturated), _those(joints, data.late)
        return TorqueCommand(data.commanded.copy(), report)


def check_springs(values: Mapping[str, float]) -> None:
    """Raises :class:`ConfigError` for what is none of ``LIVE_IMPEDANCE``, and for a value out of range."""
    for name in values.keys() - set(LIVE_IMPEDANCE):
        allowed = ", ".join(LIVE_IMPEDANCE)
        raise ConfigError(f"impedance: {name} = {values[name]!r:.40}: while a controller runs: {allowed}")
    validated(ImpedanceSettings, "impedance: ", dict(values), strict=True)


def _those(names: tuple[str, ...], which: BoolArray | Array) -> tuple[str, ...]:
    return tuple(compress(names, which.tolist()))
