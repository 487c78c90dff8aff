"""Cartesian impedance control: turn the QP's reference into joint torques with which each tool is a damped spring.

    tau = J' (K e + D e') + N (K_n (q_r - q) + D_n (v_r - v)) + M(q) a_r + C(q, v) v + g(q) + joint-limit repulsion

e is the displacement from the measured tool pose to the tool pose of the reference, and e' is the twist of the tool at
the reference minus its measured twist. D is the damping of :func:`inertia_and_damping`, D_n the damping of each joint,
and N a nullspace projector. Hogan 1985, Albu-Schaeffer et al. 2003.

**Feed-forward M a_r.** The inertia of an arm at its tool comes mainly from the rotors of its motors, because their
inertia is multiplied by the squared gear ratio. It is 20 to 140 kg for a robot of 22 kg. Without the feed-forward,
every acceleration would stretch the spring, by 30 mm at 1 m/s^2. With the feed-forward, the spring bears only the
errors of the model, and may be soft. How a resting arm yields to a push does not change.

**Torque rate.** In a full stop at 10 rad/s^2, the torque of a joint that moves the whole arm changes by 70 Nm. The
torque rises no faster than ``torque_rate_limit``, and meanwhile the tool deviates from the reference. During this time,
the measured arm may be closer to another body than the reference is permitted to be.

**Payload.** A held object is part of M, C and g. Its mass is added and removed linearly over 0.3 s, so that no torque
jumps.

**Time.** A reference is due at the end of its tick, and the state is measured at the start of the tick. The spring
therefore pulls the tool towards the reference of the previous tick, which is due now. a_r is the acceleration that
leads from this reference to the newest reference.
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

_PAYLOAD_TIME = 0.3  # Time over which the mass of a payload is added or removed [s].


@dataclass(slots=True)
class ImpedanceReport:
    """The result of one tick. Joints and arms are given by name."""

    # For each arm, the clipped displacement (6,) from the tool to the reference, in world axes [m], [rad].
    errors: dict[str, Array]
    clipped: tuple[str, ...]  # Arms whose deviation from their reference is clipped.
    saturated: tuple[str, ...]  # Joints for which the control law asks for more torque than their limit.
    rate_limited: tuple[str, ...]  # Joints whose torque would have to change faster than ``torque_rate_limit`` allows.
    repelled: tuple[str, ...]  # Joints that are pushed away from a position limit.
    held: bool  # True if the state was not usable. The command is then the gravity torque at the last usable posture.


@dataclass(slots=True)
class TorqueCommand:
    """Joint torques of one tick."""

    tau: Array  # (nv,) [Nm]
    report: ImpedanceReport


class ImpedanceController:
    """Turns the reference and the measured state of each tick into joint torques, for all arms of a cell.

    For any input the torques are finite, within ``torque_scale`` times the robot's limits, and change between two ticks
    by no more than ``torque_rate_limit`` allows. Torques are computed for each arm alone, with its own blocks of the
    inertia matrix and of the inverse of this matrix. A joint that moves several arms gets the sum of the torques for
    these arms.
    """

    def __init__(self, robot: Robot, settings: ImpedanceSettings | None = None) -> None:
        self.robot, self._arms = robot, tuple(robot.arms)
        self.settings = settings = settings or ImpedanceSettings()
        self._limit = settings.torque_scale * robot.torque_limit
        self._payloads = {arm: held for arm, held in robot.objects.by_arm.items() if held.config.mass > 0.0}
        self._borne = dict.fromkeys(self._payloads, 0.0)  # Share of each payload's mass that its arm bears now.
        self._wanted_borne = dict(self._borne)
        spring = settings.limit_stiffness, settings.limit_damping, settings.limit_distance
        limits = PositionLimits(robot.position_lower, robot.position_upper, *spring)
        largest_error = np.array([settings.max_position_error, settings.max_rotation_error])
        model = ImpedanceModel(chain_of(robot.model), tools_of(robot), limits, self._limit, largest_error)
        values = [float(getattr(settings, name)) for name in LIVE_IMPEDANCE]
        self._springs = np.tile(values, (len(self._arms), 1))  # The present values of ``LIVE_IMPEDANCE``.
        self._kernel_data = ImpedanceData.empty(model, self._springs)
        self._inputs = self._kernel_data.inputs.reshape(-1)  # A view of ``inputs``, which has the same memory.
        self._pointers = pointer_to(model), pointer_to(self._kernel_data)
        self._impedance_torque = bound(impedance_torque, *self._pointers, 0.0)
        self._model = robot.model.copy()  # The masses of payloads are added to this copy.
        self._pinocchio_data = self._model.createData()
        self._wanted_springs = self._springs.copy()  # The values at the end of the present change.
        self._ramp_rate = np.zeros_like(self._springs)
        self._ramping = False
        self._begin(robot.home)

    def reset(self, state: RobotState) -> None:
        """Start again at rest at the measured posture. The first torque is the gravity torque at this posture.

        Changes of stiffness, damping or payload that have not ended yet are completed at once.

        Raises:
            RobotError: If the posture is not nv finite numbers.
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
        self._usable_q = q  # The newest measured posture that was usable.
        data.commanded[:] = np.minimum(np.maximum(self.gravity(q), -self._limit), self._limit)

    def gravity(self, q: Array) -> Array:
        """Return the torque (nv,) [Nm] that bears the weight of arms and payloads at a posture ``q`` (nv,) [rad]."""
        return np.array(pin.computeGeneralizedGravity(self._model, self._pinocchio_data, q))

    def set_holding(self, holding: Mapping[str, bool]) -> None:
        """Set for each arm whether its gripper holds its object. The arm bears the mass of a held object."""
        for arm in self._payloads:
            self._wanted_borne[arm] = float(holding.get(arm, False))

    def _bear(self, change: float) -> None:
        """Move the share of each payload's mass that its arm bears towards the wanted share, by at most ``change``."""
        inertias = {held.joint: self.robot.model.inertias[held.joint] for held in self._payloads.values()}
        for arm, held in self._payloads.items():
            way = self._wanted_borne[arm] - self._borne[arm]
            self._borne[arm] += min(max(way, -change), change)
            if self._borne[arm] > 0.0:
                inertias[held.joint] = inertias[held.joint] + held.inertia(self._borne[arm])
        for joint, inertia in inertias.items():
            self._model.inertias[joint] = inertia

    def change(self, values: Mapping[str, float], arm: str | None = None) -> None:
        """Change stiffness and damping of one arm, or of all arms if ``arm`` is None.

        The keys of ``values`` are names in ``LIVE_IMPEDANCE``. The values change linearly over ``ramp_time``, because
        the energy of a stretched spring rises with its stiffness.

        Raises:
            ConfigError: If there is no such name or arm, or a value is out of range. Then nothing is changed.
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
        """Return an arm's present values of the settings in ``LIVE_IMPEDANCE``."""
        return dict(zip(LIVE_IMPEDANCE, self._springs[self._arms.index(arm)].tolist(), strict=True))

    def step(self, reference: Reference, state: RobotState, dt: float, extra: Array | None = None) -> TorqueCommand:
        """Return the torques for one tick.

        Args:
            reference: The reference, which is due at the end of the tick. If it is not finite, it is not used, and the
                arms are held at the last reference.
            state: The state that was measured at the start of the tick. If the state, or a torque that is computed from
                it, is not finite, the command is the gravity torque at the last usable posture. At an unknown posture,
                a spring could push in any direction.
            dt: Duration of the tick [s]. A duration outside (0, 0.1] counts as 0 or as 0.1.
            extra: Torque that is added before saturation (nv,) [Nm].
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
    """Raise :class:`ConfigError` if a name is not in ``LIVE_IMPEDANCE``, or if a value is out of range."""
    for name in values.keys() - set(LIVE_IMPEDANCE):
        allowed = ", ".join(LIVE_IMPEDANCE)
        raise ConfigError(f"impedance: {name} = {values[name]!r:.40}: while a controller runs: {allowed}")
    validated(ImpedanceSettings, "impedance: ", dict(values), strict=True)


def _those(names: tuple[str, ...], which: BoolArray | Array) -> tuple[str, ...]:
    return tuple(compress(names, which.tolist()))
