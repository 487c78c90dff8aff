"""Compliance in position mode: the measured wrench displaces the target that the QP follows.

In the tick it stands between teleop and control:  target -> Admittance.update -> displaced target -> QP.  The QP keeps
every limit and distance whatever is asked of it, so the displacement needs no bounds but those for the operator's
sake. Only the QP sees the displaced target: recordings and the teleop layer go on with the operator's own.

The law and its reasons stand in admittance_kernels.py. What the tool shows is the admittance in series with the servos
below it: a tool held by soft servos moves by their own give besides. Against a stiff body the loop closes through QP
and servos with their delay: with the defaults a simulated arm leans quietly on 10 kN/m, and on 30 kN/m with twice the
damping ratio or four times the mass. What the tool carries without its model knowing counts as a push downwards.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.admittance_kernels import (
    NOT_MEASURED,
    TOUCHED,
    UNUSABLE,
    AdmittanceData,
    AdmittanceModel,
    step_admittance,
)
from q2r2_control.config.control import AdmittanceSettings
from q2r2_control.control.jit import hold
from q2r2_control.control.tasks.task_model import tools_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, RobotState


@dataclass(frozen=True, slots=True)
class ArmCompliance:
    """How one arm yields. World axes, at the tool frame's origin."""

    wrench: Array  # (6,) on the tool, after the low-pass, before the dead band: force [N], torque [Nm]
    displacement: Array  # (6,) translation [m], rotation vector [rad]


@dataclass(frozen=True, slots=True)
class AdmittanceReport:
    """What the admittance did in one tick."""

    arms: dict[str, ArmCompliance]
    rejected: bool  # the measurement or dt was not finite: the last good wrench is held


class Admittance:
    """Displaces the targets of all arms so that each tool yields like M x'' + D x' + K x = F."""

    def __init__(self, robot: Robot, settings: AdmittanceSettings | None = None) -> None:
        self.settings = settings or AdmittanceSettings()
        self._model, self._data = robot.model, robot.model.createData()
        self._frames = {name: arm.frame_id for name, arm in robot.arms.items()}
        self._kernel_data = AdmittanceData.empty(len(robot.arms), robot.model.nv)
        self._held_model, self._held_data = hold(_model_of(robot, self.settings)), hold(self._kernel_data)
        # The kernel runs once here, so that it is not compiled in mid-motion.
        step_admittance(self._held_model, self._held_data, NOT_MEASURED, 0.001)
        self.reset()

    def reset(self) -> None:
        """Forget wrenches and displacements."""
        for array in (self._kernel_data.wrench, self._kernel_data.x, self._kernel_data.v):
            array[:] = 0.0
        self._rejected = False

    def update(self, targets: Mapping[str, pin.SE3 | None], state: RobotState, dt: float) -> dict[str, pin.SE3 | None]:
        """The ``targets`` (world frame), displaced after ``dt`` [s].

        ``state.tau_external`` (nv,) is J' F of the wrench F that the environment exerts on the tool; None counts as
        no touch. With no touch and the last displacement gone the targets come back as they are.

        An arm whose target is missing or None is not displaced, and its displacement ends at once: the arm holds where
        it is, and a new target, which starts where the tool is, must not be displaced by what is there already.
        Torques or a posture that are not finite hold the last wrench; a dt that is not positive and finite moves
        nothing; the report says so. A target that is not finite stays so, for the controller to refuse.
        """
        self._rejected = True
        if math.isfinite(dt) and dt > 0.0:
            measured = self._measure(state)
            self._rejected = measured == UNUSABLE
            self._kernel_data.follows[:] = [targets.get(name) is not None for name in self._frames]
            step_admittance(self._held_model, self._held_data, measured, float(dt))
        displaced = dict(targets)
        for x, name in zip(self._kernel_data.x, self._frames, strict=True):
            target = targets.get(name)
            if target is not None and x.any():
                displaced[name] = pin.SE3(pin.exp3(x[3:]) @ target.rotation, target.translation + x[:3])
        return displaced

    def report(self) -> AdmittanceReport:
        """Of the last update."""
        arms = zip(self._frames, self._kernel_data.wrench.copy(), self._kernel_data.x.copy(), strict=True)
        return AdmittanceReport({name: ArmCompliance(wrench, x) for name, wrench, x in arms}, self._rejected)

    def _measure(self, state: RobotState) -> int:
        tau, q = state.tau_external, state.q
        if tau is None:
            return NOT_MEASURED
        if not (math.isfinite(tau.sum()) and math.isfinite(q.sum())):
            return UNUSABLE
        self._kernel_data.tau[:] = tau
        pin.computeJointJacobians(self._model, self._data, q)
        for J, frame in zip(self._kernel_data.J, self._frames.values(), strict=True):
            J[:] = pin.getFrameJacobian(self._model, self._data, frame, pin.LOCAL_WORLD_ALIGNED).reshape(J.shape)
        return TOUCHED


def _model_of(robot: Robot, settings: AdmittanceSettings) -> AdmittanceModel:
    return AdmittanceModel(
        stiffness=np.array([settings.stiffness, settings.rotation_stiffness]),
        inertia=np.array([settings.mass, settings.inertia]),
        dead_band=np.array([settings.force_dead_band, settings.torque_dead_band]),
        limit=np.array([settings.max_displacement, settings.max_rotation]),
        damping_ratio=settings.damping_ratio,
        filter_time=settings.filter_time,
        member=tools_of(robot).member,
    )
