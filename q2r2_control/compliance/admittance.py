"""Compliance in position mode: the measured wrench displaces the target that the QP follows.

The QP keeps every limit and distance for any target. The displacement is therefore bounded only for the operator's
sake, and not for safety. Only the QP sees the displaced target: recordings and the teleop layer use the operator's own
target.

At the tool, the admittance acts in series with the servos of the joints. In contact with a stiff body, the feedback
loop contains the QP and the servos with their delay. With the default settings, a simulated arm rests quietly against a
body with a stiffness of 10 kN/m. With twice the damping ratio or four times the mass, it also rests quietly against a
body of 30 kN/m. A load that the model does not know counts as a push downwards.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.config.control import AdmittanceSettings
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.robot.robot import Arm, Robot
from q2r2_control.types import Array, RobotState

_METRES = np.array([1.0, 1.0, 1.0, *[ROTATION_LENGTH] * 3])  # Factors that convert the rows of J to metres.
# A direction counts as singular if its singular value of J, with all rows in metres, is below this [m]. At this value,
# a torque error of 0.1 Nm causes a force error of 2 N.
_SINGULAR = 0.05
_NOTHING = 1e-9  # Displacements [m], [rad] and velocities [m/s], [rad/s] below this count as zero.


def estimate_wrench(J: Array, tau: Array) -> Array:
    """Return the least-squares wrench (6,) [N, Nm] for the torques ``tau`` (n,) [Nm] of an arm with Jacobian J (6, n).

    With J J' = V s^2 V', the wrench is F = V f(s) V' J tau, where f(s) is 1 / s^2, and smaller for singular directions.
    """
    scaled = _METRES[:, None] * J
    values, directions = np.linalg.eigh(scaled @ scaled.T)
    values = np.maximum(values, 0.0)
    deficit = np.maximum(1.0 - values / _SINGULAR**2, 0.0)
    along = directions.T @ (scaled @ tau)
    wrench: Array = _METRES * (directions @ (along / (values + (_SINGULAR * deficit) ** 2)))
    return wrench


def rest_displacement(force: Array, dead_band: float, stiffness: float, limit: float) -> Array:
    """Return the displacement (3,) [m or rad] at which the spring balances the ``force`` (3,) [N or Nm].

    The result is zero if the force is within the dead band. It is at most ``limit`` long.
    """
    size = math.hypot(*force)
    if size <= dead_band:
        return np.zeros(3)
    return np.asarray(force * min((1.0 - (dead_band / size) ** 2) / stiffness, limit / size))


def stop_at_limit(x: Array, v: Array, limit: float) -> tuple[Array, Array]:
    """Return ``x`` (3,) shortened to ``limit``, and ``v`` (3,) without its outward part if ``x`` was too long."""
    length = math.hypot(*x)
    if length <= limit:
        return x, v
    out = x / length
    return limit * out, v - max(float(out @ v), 0.0) * out


def oscillate(x: Array, v: Array, frequency: float, damping_ratio: float, dt: float) -> tuple[Array, Array]:
    """Return the exact solution of x'' + 2 xi w x' + w^2 x = 0 after ``dt`` [s], with the ``frequency`` w [rad/s]."""
    fall = damping_ratio * frequency
    spread = frequency * math.sqrt(abs(damping_ratio**2 - 1.0))
    # ``cosine`` is e^(-fall t) times cos or cosh, and ``sine`` is e^(-fall t) times sin or sinh, divided by ``spread``.
    # They are computed in a form without overflow.
    if spread * dt < 1e-6:
        cosine = math.exp(-fall * dt)
        sine = cosine * dt
    elif damping_ratio < 1.0:
        cosine = math.exp(-fall * dt) * math.cos(spread * dt)
        sine = math.exp(-fall * dt) * math.sin(spread * dt) / spread
    else:
        slow, fast = math.exp((spread - fall) * dt), math.exp(-(spread + fall) * dt)
        cosine = 0.5 * (slow + fast)
        sine = 0.5 * (slow - fast) / spread
    return (cosine + fall * sine) * x + sine * v, (cosine - fall * sine) * v - frequency**2 * sine * x


@dataclass(frozen=True, slots=True)
class ArmCompliance:
    """The wrench and the displacement of one arm, in world axes at the origin of the tool frame."""

    wrench: Array  # (6,) Wrench on the tool after the low-pass filter, before the dead band: force [N], torque [Nm].
    displacement: Array  # (6,) Translation [m], rotation vector [rad].


@dataclass(frozen=True, slots=True)
class AdmittanceReport:
    """The result of the admittance in one tick."""

    arms: dict[str, ArmCompliance]
    rejected: bool  # True if the measurement or dt could not be used. The last good wrench is then used.


class Admittance:
    """Displaces the target of each arm by the x that solves M x'' + D x' + K x = F, so that the tool yields to F."""

    def __init__(self, robot: Robot, settings: AdmittanceSettings | None = None) -> None:
        self.settings = settings or AdmittanceSettings()
        self._model, self._data = robot.model, robot.model.createData()
        self._arms: dict[str, Arm] = dict(robot.arms)
        self.reset()

    def reset(self) -> None:
        """Forget wrenches and displacements."""
        self._wrench = {arm: np.zeros(6) for arm in self._arms}  # After the low-pass filter [N], [Nm].
        self._x = {arm: np.zeros(6) for arm in self._arms}  # Displacement [m], [rad].
        self._v = {arm: np.zeros(6) for arm in self._arms}  # [m/s], [rad/s]
        self._rejected = False

    def update(self, targets: Mapping[str, pin.SE3 | None], state: RobotState, dt: float) -> dict[str, pin.SE3 | None]:
        """Return the displaced targets.

        If an arm has no target, its displacement becomes zero at once, because a new target starts at the tool's pose.
        If a torque or the posture is not finite, the last wrench is used. If dt is not positive and finite, no
        displacement changes. In both cases, ``rejected`` of the report is True. A target that is not finite is passed
        on, and the controller refuses it.

        Args:
            targets: Targets of the tools, in the world frame.
            state: The measured state. ``tau_external`` (nv,) is J' F for the wrench F of the environment on the tool;
                None counts as no contact.
            dt: Time since the last call [s].
        """
        self._rejected = not (math.isfinite(dt) and dt > 0.0)
        if not self._rejected:
            self._filter_wrenches(state, dt)
            for arm in self._arms:
                self._displace(arm, targets.get(arm) is not None, dt)
        displaced = dict(targets)
        for arm, x in self._x.items():
            target = targets.get(arm)
            if target is not None and x.any():
                displaced[arm] = pin.SE3(pin.exp3(x[3:]) @ target.rotation, target.translation + x[:3])
        return displaced

    def report(self) -> AdmittanceReport:
        """The report of the last update."""
        arms = {arm: ArmCompliance(self._wrench[arm].copy(), x.copy()) for arm, x in self._x.items()}
        return AdmittanceReport(arms, self._rejected)

    def _filter_wrenches(self, state: RobotState, dt: float) -> None:
        """Let the filtered wrench of every arm approach the measured wrench, or zero if no torque is measured."""
        tau, q = state.tau_external, state.q
        if tau is not None:
            self._rejected = not (math.isfinite(tau.sum()) and math.isfinite(q.sum()))
            if self._rejected:
                return
            pin.computeJointJacobians(self._model, self._data, q)
        time = self.settings.filter_time
        share = 1.0 - math.exp(-dt / time) if time > 0.0 else 1.0
        for name, arm in self._arms.items():
            estimate = np.zeros(6)
            if tau is not None:
                J = pin.getFrameJacobian(self._model, self._data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)
                estimate = estimate_wrench(J[:, arm.joints], tau[arm.joints])
            self._wrench[name] += share * (estimate - self._wrench[name])

    def _displace(self, arm: str, follows: bool, dt: float) -> None:
        """Compute the displacement of one arm ``dt`` [s] later. It is zero if the arm follows no target."""
        law, wrench, x, v, pushed = self.settings, self._wrench[arm], self._x[arm], self._v[arm], False
        linear = (slice(0, 3), law.stiffness, law.mass, law.force_dead_band, law.max_displacement)
        angular = (slice(3, 6), law.rotation_stiffness, law.inertia, law.torque_dead_band, law.max_rotation)
        for part, stiffness, inertia, dead_band, limit in (linear, angular):
            rest = rest_displacement(wrench[part], dead_band, stiffness, limit)
            away, v[part] = oscillate(x[part] - rest, v[part], math.sqrt(stiffness / inertia), law.damping_ratio, dt)
            x[part], v[part] = stop_at_limit(rest + away, v[part], limit)
            pushed |= bool(rest.any())
        if not follows or (not pushed and max(np.abs(x).max(), np.abs(v).max()) < _NOTHING):
            x[:], v[:] = 0.0, 0.0
