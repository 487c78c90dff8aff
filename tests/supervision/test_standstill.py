"""A controller that stands still is found although joint states arrive. Arms that lag or reverse are not reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.supervision.standstill import (
    JOINTS,
    LAGGING_JOINTS,
    LAGGING_TOOL,
    WINDOW,
    StandstillLimits,
    StandstillWatch,
)
from q2r2_control.supervision.supervisor import Supervisor
from q2r2_control.supervision.target_stream import Origins, StreamSettings
from q2r2_control.types import Array, RobotState
from tests.supervision.conftest import STRICT

DT = 0.004
WITHIN = 0.1  # Longest time until the standstill is found [s].
FROZEN_AT = 0.6  # Time at which the driver stops [s].


def swinging(speed: float, hertz: float) -> Callable[[float], Array]:
    """Return joints that begin at rest and move to and fro; ``speed`` is their largest speed [rad/s]."""
    turn = 2.0 * np.pi * hertz
    return lambda t: np.array([0.0, 1.0, -0.4]) * speed / turn * (1.0 - np.cos(turn * max(t, 0.0)))


def ramp(speed: float, acceleration: float) -> Callable[[float], Array]:
    """Return joints that accelerate to a speed and keep it."""
    rise = speed / acceleration

    def at(t: float) -> Array:
        t = max(t, 0.0)
        way = 0.5 * acceleration * t * t if t < rise else speed * (t - 0.5 * rise)
        return np.array([way, 0.0, 0.3 * way])

    return at


def findings(
    limits: StandstillLimits,
    asked: Callable[[float], Array],
    *,
    seconds: float = 2.0,
    delay: float = 0.0,
    lag: float = 0.02,
    frozen_at: float = np.inf,
    heard: Callable[[float], bool] = lambda t: True,
    ticks: Callable[[float], bool] = lambda t: True,
    state_period: float = DT,
) -> Iterator[float]:
    """Yield the times at which the watch reports an arm [s].

    The arm follows its commands with a ``delay`` [s] and a first-order ``lag`` [s]. From ``frozen_at`` on, its driver
    holds the last command. A state can arrive at the time t only if ``heard(t)`` is True. The loop ticks and sends a
    command only if ``ticks(t)`` is True.
    """
    watch, measured, stamp, command = StandstillWatch(limits), asked(0.0), 0.0, asked(0.0)
    seen, next_state = measured, 0.0
    for t in np.arange(0.0, seconds, DT):
        measured = measured + (command - measured) * (DT / lag)
        if t < frozen_at and ticks(t):  # The command of a tick is valid until the next tick.
            command = asked(t - delay)
        if t >= next_state and heard(t):
            seen, stamp, next_state = measured, t, next_state + state_period
        if ticks(t) and watch.look(asked(t), seen, stamp, t) is not None:
            yield float(t)


@pytest.mark.parametrize("speed", [0.4, 1.2, 2.0])
@pytest.mark.parametrize("motion", [lambda speed: ramp(speed, 8.0), lambda speed: swinging(speed, 0.2)])
def test_a_driver_that_stops_during_motion_is_found_within_a_tenth_of_a_second(
    speed: float, motion: Callable[[float], Callable[[float], Array]]
) -> None:
    found = next(findings(JOINTS, motion(speed), lag=0.008, frozen_at=FROZEN_AT))
    assert FROZEN_AT < found < FROZEN_AT + WITHIN + DT


def test_a_driver_that_never_begins_to_follow_is_found_before_the_command_is_0_1_rad_away() -> None:
    asked = ramp(1.2, 8.0)
    found = next(findings(JOINTS, asked, frozen_at=0.0))
    assert float(np.abs(asked(found)).max()) < 0.1


@pytest.mark.parametrize(("limits", "allowed"), [(LAGGING_JOINTS, 0.3), (LAGGING_TOOL, 0.3)])
def test_a_controller_that_may_lag_is_found_if_it_has_followed_and_then_stops(
    limits: StandstillLimits, allowed: float
) -> None:
    found = next(findings(limits, ramp(0.6, 8.0), lag=0.03, frozen_at=FROZEN_AT))
    assert FROZEN_AT < found <= FROZEN_AT + allowed


LAGS = {
    "drivers": (JOINTS, 0.04, 0.02),
    "a slow driver": (JOINTS, 0.0, 0.08),
    "a controller of poses": (LAGGING_JOINTS, 0.1, 0.2),
    "a late controller of poses": (LAGGING_JOINTS, 0.3, 0.03),
    "a late tool": (LAGGING_TOOL, 0.3, 0.03),
}


@pytest.mark.parametrize(("limits", "delay", "lag"), LAGS.values(), ids=LAGS)
@pytest.mark.parametrize("hertz", [0.1, 0.4, 1.0, 2.0])
@pytest.mark.parametrize("speed", [0.3, 1.5])
def test_an_arm_that_lags_is_not_reported_as_standing_when_it_starts_or_reverses(
    limits: StandstillLimits, delay: float, lag: float, hertz: float, speed: float
) -> None:
    assert list(findings(limits, swinging(speed, hertz), seconds=6.0, delay=delay, lag=lag)) == []


def test_a_controller_with_a_delay_may_begin_late_again_after_a_rest() -> None:
    motion = swinging(0.6, 1.0)

    def asked(t: float) -> Array:
        return motion(min(t, 1.0)) if t < 2.0 else motion(t - 2.0)

    assert list(findings(LAGGING_JOINTS, asked, seconds=3.0, delay=0.3, lag=0.03)) == []


def test_no_standstill_is_reported_while_ticks_or_joint_states_are_missing() -> None:
    """A loop that stood still has sent no commands. While no states come, the motion of the arm is unknown."""

    def gap(t: float) -> bool:
        return not FROZEN_AT < t < FROZEN_AT + 0.08

    asked = ramp(1.2, 8.0)
    assert list(findings(JOINTS, asked, ticks=gap, lag=0.008)) == []
    assert list(findings(JOINTS, asked, heard=gap)) == []
    found = next(findings(JOINTS, asked, ticks=gap, lag=0.008, frozen_at=1.0))
    assert 1.0 < found <= 1.0 + WITHIN


def test_no_standstill_is_reported_before_a_whole_window_has_passed() -> None:
    """The command moves away at once, while the measured arm stays."""
    watch, still = StandstillWatch(JOINTS), np.zeros(3)
    for step in range(40):
        t = step * DT
        found = watch.look(np.full(3, 2.0 * t), still, t, t)
        assert found is None or t >= WINDOW
    assert found is not None


def test_a_standstill_is_noticed_even_if_only_fifty_states_come_in_a_second() -> None:
    asked = ramp(1.2, 8.0)
    assert list(findings(JOINTS, asked, state_period=0.02)) == []
    assert next(findings(JOINTS, asked, state_period=0.02, lag=0.008, frozen_at=FROZEN_AT)) <= FROZEN_AT + 0.12


class Cell:
    """A supervisor of arms that other processes move, named ``/left_jtc`` and ``/right_jtc``."""

    def __init__(self, robot: Robot, controller: CartesianController) -> None:
        self.tool = controller.tool_pose
        origins = Origins(takers=lambda arm: f" /{arm}_jtc")
        self.supervisor = Supervisor(robot, controller, StreamSettings(), STRICT, origins, standstill=JOINTS)
        self.q, self.now, self.frozen = robot.home.copy(), 0.0, np.zeros(len(robot.home), dtype=bool)
        self.v = np.zeros_like(self.q)

    def run(self, seconds: float, speed: Array, start: dict[str, pin.SE3] | None = None) -> None:
        began, zero = self.now, np.zeros_like(self.q)
        for _ in range(round(seconds / DT)):
            self.now += DT
            self.supervisor.update_state(RobotState(self.q, self.v, zero, None, self.now), self.now)
            for arm, pose in (start or {}).items():
                shifted = pin.SE3(pose.rotation, pose.translation + (self.now - began) * speed)
                self.supervisor.update_target(arm, shifted, self.now)
            reference = self.supervisor.tick(self.now, DT)
            way = zero if reference is None else reference.q - self.q
            self.v = np.where(self.frozen, 0.0, way / DT)
            self.q = self.q + self.v * DT


def test_both_arms_are_stopped_if_the_driver_of_one_arm_stands_still(
    robot: Robot, controller: CartesianController
) -> None:
    cell = Cell(robot, controller)
    up = np.array([0.0, 0.0, 0.25])
    cell.run(0.2, up)
    start = {arm: cell.tool(arm) for arm in robot.arms}
    cell.run(0.02, 0.0 * up, start)
    cell.run(0.5, up, start)
    assert [cell.supervisor.arm_state(arm) for arm in robot.arms] == ["following"] * 2
    cell.frozen[robot.arms["left"].joints] = True
    start = {arm: cell.tool(arm) for arm in robot.arms}
    cell.run(WITHIN, up, start)
    assert [cell.supervisor.arm_state(arm) for arm in robot.arms] == ["braking"] * 2
    fault = cell.supervisor.fault
    assert fault is not None
    assert (fault.kind, fault.detail["arm"], fault.detail["takers"]) == (
        SupervisionReason.CONTROLLER_STANDS,
        "left",
        " /left_jtc",
    )
