"""Arms that follow their common reference with different lags brake together, whichever loop moves them."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.supervision.arm_skew import SkewWatch, allowed_skew, skew_window
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.types import ArmTiming
from q2r2_control.wording import sentence
from tests.supervision.test_supervisor import DT, World, raised

PERIOD = 0.005  # Period of the arms' messages [s].


def timings(
    left: float = 0.0, right: float = 0.0, silent: tuple[float, float] = (0.0, 0.0), noise: float = 0.0
) -> dict[str, ArmTiming]:
    """Return the timings of two arms. All arguments are in periods.

    ``left`` and ``right`` are the lags that the arms report. ``silent`` are the times since these reports,
    and ``noise`` is the noise of the lags.
    """
    behind = {"left": left, "right": right}
    return {
        arm: ArmTiming(PERIOD * lag, PERIOD * quiet, PERIOD, PERIOD * noise)
        for (arm, lag), quiet in zip(behind.items(), silent, strict=True)
    }


@pytest.mark.parametrize(
    ("found", "holds"),
    [
        pytest.param(timings(), False, id="both in time"),
        pytest.param(timings(left=50.0, right=50.0), False, id="both late alike"),
        pytest.param(timings(left=1.0, silent=(1.0, 0.0)), False, id="one message lost"),
        pytest.param(timings(left=2.3), True, id="more than two periods apart"),
        pytest.param(timings(right=2.3), True, id="the other one behind"),
        pytest.param(timings(left=2.8, noise=0.7), False, id="apart by no more than the lags are noisy"),
        pytest.param(timings(left=3.0, noise=0.7), True, id="farther apart than the lags are noisy"),
        pytest.param(timings(left=1.5, silent=(1.9, 0.0)), True, id="behind, and a message is missing"),
        pytest.param(timings(silent=(2.2, 0.1)), False, id="one silent for two periods and its jitter"),
        pytest.param(timings(silent=(2.4, 0.1)), True, id="one silent for longer than two periods"),
        pytest.param(timings(silent=(20.0, 20.0)), False, id="this loop stood still"),
        pytest.param({"left": ArmTiming(1.0, 1.0, PERIOD)}, False, id="a single arm"),
        pytest.param({}, False, id="arms that move as one"),
    ],
)
def test_arms_brake_while_their_lags_differ_by_more_than_is_allowed(found: dict[str, ArmTiming], holds: bool) -> None:
    watch = SkewWatch()
    watch.observe(found, 0.0)
    assert watch.holds == holds


def test_the_skew_window_is_the_allowed_skew_plus_two_message_periods_plus_the_given_time() -> None:
    found = timings()
    assert skew_window(found, 0.004) == pytest.approx(allowed_skew(found) + 2.0 * PERIOD + 0.004)
    found["left"] = ArmTiming(0.0, 0.0, 2.0 * PERIOD)
    assert skew_window(found, 0.004) == pytest.approx(0.001 + 8.0 * PERIOD + 0.004), "the slower messages count"
    assert skew_window({"left": found["left"]}, 0.004) == 0.0


def test_if_lags_differ_for_too_long_the_arm_that_is_behind_is_named() -> None:
    watch = SkewWatch()
    watch.observe(timings(), 0.0)
    watch.observe(timings(right=4.0), 0.05)
    assert watch.fault(0.05) is None
    watch.observe(timings(right=4.0), 0.11)
    fault = watch.fault(0.11)
    assert fault is not None
    assert sentence(fault) == "right: 20 ms behind the other arm; allowed: 11 ms"


def test_if_lags_differ_since_the_first_tick_the_arms_are_stopped_after_a_tenth_of_a_second() -> None:
    watch, found = SkewWatch(), []
    for now in (5.0, 5.09, 5.11):
        watch.observe(timings(left=4.0), now)
        found.append(watch.fault(now) is not None)
    assert found == [False, False, True]


def test_both_arms_brake_while_one_arm_is_behind_and_go_on_when_it_has_caught_up(
    robot: Robot, controller: CartesianController
) -> None:
    world = World(robot, controller)
    left, right = world.engage_both()

    def go(seconds: float, skew: float) -> float:
        """Send both tools to 50 mm above their start, while the left arm lags by ``skew`` periods.

        Return the speed of the fastest joint at the end [rad/s].
        """
        for _ in range(round(seconds / DT)):
            world.supervisor.skew.observe(timings(left=skew), world.now)
            world.run(DT, raised(left, 0.05), right=raised(right, 0.05))
        before, now = world.commanded[-2:]
        assert before is not None
        assert now is not None
        return float(np.abs(now - before).max() / DT)

    fastest = go(0.1, 0.0)
    assert go(0.03, 3.0) < fastest - 0.2
    assert world.states == ["following"] * 2
    go(1.0, 0.0)
    assert world.states == ["following"] * 2
    assert controller.tool_pose("left").translation[2] == pytest.approx(left.translation[2] + 0.05, abs=1e-3)


def test_if_lags_stay_different_the_arms_are_stopped_and_hold_even_if_the_lags_become_equal_again(
    robot: Robot, controller: CartesianController
) -> None:
    world = World(robot, controller)
    left, right = world.engage_both()
    for _ in range(60):
        world.supervisor.skew.observe(timings(left=3.0), world.now)
        world.run(DT, raised(left, 0.05), right=raised(right, 0.05))
    assert SupervisionReason.ARMS_APART in {event.root.kind for event in world.supervisor.events}
    assert world.states != ["following"] * 2
    world.supervisor.skew.observe(timings(), world.now)
    world.run(1.0)
    assert world.states == ["holding"] * 2
