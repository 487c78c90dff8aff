"""Run a controller from a given start, and check its contract at every tick."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control import CartesianController
from q2r2_control.types import Array, Reference
from q2r2_control.verification.contract import Contract

Targets = Mapping[str, pin.SE3 | None]
# The arguments are the time since the start [s] and the tool pose of each arm at the start.
Scenario = Callable[[float, Mapping[str, pin.SE3]], Targets]


class Driven:
    """A run that starts at home, or at ``q`` and ``v``; ``options`` are passed to the contract."""

    def __init__(
        self,
        controller: CartesianController,
        q: Array | None = None,
        v: Array | None = None,
        dt: float = 0.002,
        **options: Any,
    ) -> None:
        self.controller, self.robot, self.dt = controller, controller.robot, dt
        q = self.robot.home if q is None else q
        controller.reset(q, v)
        self.start = {arm: controller.tool_pose(arm) for arm in self.robot.arms}
        self.contract = Contract(controller, q, v, **options)
        self.ticks = 0
        self.q, self.v, self.a = q, np.zeros_like(q) if v is None else v, np.zeros_like(q)

    def drive(self, seconds: float, towards: Scenario | Targets | None = None) -> Reference:
        """Step the controller for ``seconds`` [s] towards fixed or moving targets, and return the last reference."""
        for _ in range(max(round(seconds / self.dt), 1)):
            targets = towards(self.ticks * self.dt, self.start) if callable(towards) else towards or {}
            reference = self.controller.step(targets, self.dt)
            self.contract.check(reference, self.dt)
            self.ticks += 1
        self.q, self.v, self.a = reference.q, reference.v, reference.a
        return reference

    def set_opening(self, arm: str, least: float, greatest: float) -> tuple[str, str] | None:
        """Call the controller's method ``set_opening``, and give the new openings to the contract."""
        refused = self.controller.set_opening(arm, least, greatest)
        self.contract.set_openings(self.controller.openings)
        return refused
