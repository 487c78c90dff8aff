"""Two arms whose drivers do not report their lag stay apart if one arm stands still or its driver falls silent."""

from __future__ import annotations

from collections import deque

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.control.controller import CartesianController
from q2r2_control.drives.base import make_drive
from q2r2_control.loop.control_loop import ControlLoop
from q2r2_control.supervision.joint_watch import watch_settings
from q2r2_control.supervision.target_stream import StreamSettings
from q2r2_control.types import SIDES, ArmTiming, Array, CommandMode, RobotState
from tests.control.test_arm_skew import Ways, beside_each_other, swung
from tests.support.processes import cell, cell_robot

DT, PERIOD, LAG = 0.005, 0.005, 0.04  # Periods of the loop and of the drivers' messages, and the lag of their arms [s].
HAPPENS = 1.51  # The time of the fault, at which both arms move to the left at their highest speed [s].


class TwoDrivers:
    """Arms that swing together, near each other, each ``LAG`` behind the reference."""

    def __init__(self, are_watched: bool = True) -> None:
        config, robot = cell(), cell_robot()
        drive, watch = make_drive(CommandMode.POSITION, robot, config), watch_settings(config.supervision, False)
        self.controller = controller = CartesianController(robot, config.control.timed(realtime=False))
        self.robot, self.are_watched = robot, are_watched
        self.start = beside_each_other(controller, 0.0)
        self.loop = ControlLoop(controller, drive, DT, StreamSettings(), watch)
        self.path = deque([controller.step({}, 1e-9).q] * round(LAG / DT), maxlen=round(LAG / DT))
        self.q, self.now = self.path[0].copy(), 0.0
        self.standing: set[str] = set()
        self.silent: dict[str, float] = {}  # The times since which drivers are silent [s].
        self.margins: list[float] = []
        self.speeds: list[float] = []
        self.between = Ways(controller).between
        self.watch()
        self.loop.activate(self.state, 0.0)

    @property
    def state(self) -> RobotState:
        zero = np.zeros_like(self.q)
        return RobotState(self.q.copy(), zero, zero, None, self.now)

    def watch(self) -> None:
        timings = {arm: ArmTiming(None, self.now - self.silent.get(arm, self.now), PERIOD, 0.01) for arm in SIDES}
        self.loop.watch_skew(timings if self.are_watched else {}, DT + 0.01, self.now)

    def tick(self) -> None:
        self.now += DT
        self._move(self.path[0])
        self.loop.observe(self.state, self.now, DT)
        self.watch()
        targets: dict[str, pin.SE3 | None] = swung(self.start, self.now, 0.5)
        step = self.loop.step(self.state, targets, self.now, DT, dict.fromkeys(SIDES, 1.0), {})
        assert step.reference is not None
        self.path.append(step.reference.q)
        self.speeds.append(float(np.abs(step.reference.v).max()))

    def _move(self, q: Array) -> None:
        for arm, its in self.robot.arms.items():
            if arm not in self.standing:
                self.q[its.joints] = q[its.joints]
        distances = self.robot.distance_values(self.q) - self.controller.kept_distances
        self.margins.append(float(distances[self.between].min()))

    def run_until(self, end: float) -> None:
        while self.now < end:
            self.tick()


@pytest.mark.slow
@pytest.mark.parametrize("are_watched", [True, False])
def test_an_arm_keeps_its_distance_from_an_arm_that_stands_still_only_if_their_lags_are_watched(
    are_watched: bool,
) -> None:
    arms = TwoDrivers(are_watched)
    arms.run_until(HAPPENS)
    assert min(arms.margins) >= 0.0
    arms.standing.add("left")
    arms.run_until(HAPPENS + 0.3)
    assert (min(arms.margins) >= 0.0) == are_watched


def test_the_other_arm_brakes_at_once_when_one_driver_has_been_silent_for_two_periods() -> None:
    arms = TwoDrivers()
    arms.run_until(HAPPENS)
    before = arms.speeds[-1]
    arms.standing.add("left")
    arms.silent["left"] = arms.now
    arms.run_until(arms.now + 2.0 * PERIOD + 3.0 * DT)
    assert arms.speeds[-1] < before - 2.0 * DT


def test_arms_with_equal_lags_are_not_slowed() -> None:
    arms = TwoDrivers()
    arms.run_until(HAPPENS)
    assert max(arms.speeds) > 0.3
    assert not arms.loop.supervisor.skew.holds
