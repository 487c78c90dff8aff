"""Conditions of an arm that its hand feels: nearness, position limits, contact. For both loops."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.admittance import estimate_wrench
from q2r2_control.control.controller import CartesianController
from q2r2_control.teleop.haptics import ArmCondition
from q2r2_control.types import LimitKind, RobotState, StepReport

_LIMIT_LASTS = 0.5  # a joint counts as at its limit for so long after it last was: limits bind on and off [s]


class ArmConditions:
    """Looks at a controller and at what was measured. Times are the loop's [s]."""

    def __init__(self, controller: CartesianController) -> None:
        robot = controller.robot
        self._controller, self._robot = controller, robot
        self._data = robot.model.createData()
        self._joints = {arm: {robot.joint_names[j] for j in robot.arms[arm].joints} for arm in robot.arms}
        self._limited: dict[str, float] = {}  # when a joint last was at its position limit [s]

    def note(self, report: StepReport, now: float) -> None:
        """Remember which limits held up a step; of every tick."""
        for kind, names in report.binding:
            if kind is LimitKind.POSITION:
                self._limited[names[0]] = now

    def look(self, state: RobotState, now: float) -> Mapping[str, ArmCondition]:
        """Of every arm, at ``now``."""
        return {arm: self.look_at(arm, state, now) for arm in self._joints}

    def look_at(self, arm: str, state: RobotState, now: float) -> ArmCondition:
        """Of one arm, at ``now``; less often than every tick, since distances take their time."""
        self._limited = {name: t for name, t in self._limited.items() if now - t <= _LIMIT_LASTS}
        limited = frozenset(self._joints[arm] & self._limited.keys())
        return ArmCondition(self._controller.spare_distance(arm), limited, self._contact_force(arm, state))

    def _contact_force(self, arm: str, state: RobotState) -> float | None:
        """As an admittance estimates it [N]; None where nothing is measured."""
        if state.tau_external is None or not np.isfinite((state.tau_external, state.q)).all():
            return None
        chosen = self._robot.arms[arm]
        J = pin.computeFrameJacobian(self._robot.model, self._data, state.q, chosen.frame_id, pin.LOCAL_WORLD_ALIGNED)
        wrench = estimate_wrench(J[:, chosen.joints], state.tau_external[chosen.joints])
        return math.hypot(*wrench[:3].tolist())
