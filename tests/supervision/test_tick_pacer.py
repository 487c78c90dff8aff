"""A late tick moves no joint beyond its limits. A pose that follows targets keeps its limits at every step."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.config.teleop import GuardSettings
from q2r2_control.supervision.tick_pacer import PoseRateLimiter, TickClock, TickPacer
from q2r2_control.types import LONGEST_DT, Array
from tests.teleop.hands import pose

PERIOD, ACCELERATION = 0.004, np.array([10.0, 4.0])
LIMIT = np.array([1.7, 3.1])


@given(gap=st.floats(1e-6, 10.0), shares=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)))
def test_a_late_tick_moves_no_joint_farther_than_one_period_at_the_velocity_limit(
    gap: float, shares: tuple[float, float]
) -> None:
    v = LIMIT * np.array(shares)
    step = TickPacer(PERIOD, LIMIT, ACCELERATION).step(gap, v)
    assert min(gap, PERIOD) <= step * (1.0 + 1e-9)
    assert step <= gap
    if step > PERIOD * (1.0 + 1e-6):
        farthest = np.abs(v) * step + 0.5 * ACCELERATION * step * step
        assert (farthest <= LIMIT * PERIOD * (1.0 + 1e-9)).all()


def test_a_punctual_tick_keeps_its_length_and_a_tick_without_advance_of_the_clock_has_length_0() -> None:
    pacer = TickPacer(PERIOD, LIMIT, ACCELERATION)
    assert [pacer.step(gap, LIMIT) for gap in (PERIOD, 0.3 * PERIOD, 0.0, -1.0)] == [PERIOD, 0.3 * PERIOD, 0.0, 0.0]
    assert pacer.missed_ticks == 0
    assert pacer.stretched == 0.0


def test_after_a_late_tick_slow_motion_catches_up_and_fast_motion_continues_later() -> None:
    slow, fast = (TickPacer(PERIOD, LIMIT, ACCELERATION) for _ in range(2))
    assert slow.step(3.0 * PERIOD, 0.1 * LIMIT) == 3.0 * PERIOD
    assert slow.stretched == 0.0
    assert fast.step(25.0 * PERIOD, LIMIT) == PERIOD
    assert fast.stretched == pytest.approx(24.0 * PERIOD)
    assert slow.missed_ticks == 2
    assert fast.missed_ticks == 24


def test_if_the_plant_moves_on_without_commands_the_reference_moves_on_for_up_to_a_tenth_of_a_second() -> None:
    pacer = TickPacer(PERIOD, LIMIT, ACCELERATION, coasts=True)
    assert [pacer.step(gap, LIMIT) for gap in (0.09, 0.3)] == [0.09, 0.1]
    assert pacer.stretched == pytest.approx(0.2)


@pytest.mark.parametrize("slow", [1.0, 1.001], ids=["at its period", "that ticks slightly slower"])
def test_the_tick_clock_gives_evenly_spaced_and_punctual_times_to_ticks_with_jitter(slow: float) -> None:
    clock, random = TickClock(PERIOD), np.random.default_rng(1)
    ran = slow * PERIOD * np.arange(2000) + random.uniform(0.0, 6e-4, 2000)
    counted = np.array([clock.at(t) for t in ran])
    assert np.abs(counted - ran).max() < 7e-4
    assert np.diff(counted)[200:].std() < 0.05 * np.diff(ran).std()


def ten_ticks() -> TickClock:
    clock = TickClock(PERIOD)
    for k in range(10):
        clock.at(k * PERIOD)
    return clock


@pytest.mark.parametrize("late", [0.4, 1.7, 20.3])
def test_a_late_tick_advances_time_by_all_due_periods_and_an_immediate_next_tick_by_none(late: float) -> None:
    clock = ten_ticks()
    due = 10 + round(late)
    assert clock.at((10 + late) * PERIOD) == pytest.approx(due * PERIOD, abs=0.02 * PERIOD)
    last = clock.at((10 + late + 0.05) * PERIOD)
    assert last == clock.at((10 + late) * PERIOD)
    assert clock.at((due + 1) * PERIOD) == pytest.approx((due + 1) * PERIOD, abs=0.03 * PERIOD)


@pytest.mark.parametrize("gap", [0.2, -0.02])
def test_the_tick_clock_starts_anew_after_a_long_gap_and_after_the_clock_was_set_back(gap: float) -> None:
    clock = ten_ticks()
    now = 9 * PERIOD + gap
    assert clock.at(now) == now
    assert clock.at(now + PERIOD) == pytest.approx(now + PERIOD)


def test_the_tick_clock_repeats_its_last_time_if_the_given_time_goes_back_by_less_than_a_period() -> None:
    clock = ten_ticks()
    last = clock.at(10 * PERIOD)
    assert clock.at(9.5 * PERIOD) == last
    assert clock.at(8.5 * PERIOD) == 8.5 * PERIOD, "it was set back, and time begins anew"


DT = 0.01
LIMITS = GuardSettings(max_velocity=0.5, max_acceleration=5.0, max_angular_velocity=2.0, max_angular_acceleration=20.0)
FASTEST = np.array([LIMITS.max_velocity, LIMITS.max_angular_velocity])
STRONGEST = np.array([LIMITS.max_acceleration, LIMITS.max_angular_acceleration])


class Watched:
    """A guard whose steps are all compared with its limits."""

    def __init__(self, start: pin.SE3 | None = None, period: float = DT) -> None:
        self.guard, self._period = PoseRateLimiter(LIMITS, period), period
        self.now = 5.0
        self.guard.reset(start or pose(), self.now)
        self.velocity: tuple[Array, Array] = np.zeros(3), np.zeros(3)

    @property
    def pose(self) -> pin.SE3:
        assert self.guard.pose is not None
        return self.guard.pose

    def step(self, target: pin.SE3 | None, dt: float = DT) -> pin.SE3:
        if self.now + dt - self.now > LONGEST_DT:  # After a gap of this length, the motion begins from rest.
            self.velocity = np.zeros(3), np.zeros(3)
        before, last = self.pose, self.velocity
        self.now += dt
        after = self.guard.step(target, self.now)
        assert after is not None
        ways = after.translation - before.translation, pin.log3(after.rotation @ before.rotation.T)
        if dt > self._period:  # A late step moves the pose by no more than one period allows.
            for way, fastest in zip(ways, FASTEST, strict=True):
                assert math.hypot(*way) <= fastest * self._period * (1 + 1e-6) + 1e-9
            speeds = np.array([math.hypot(*velocity) for velocity in last])
            dt = TickPacer(self._period, FASTEST, 2.0 * STRONGEST).step(dt, speeds)
        self.velocity = ways[0] / dt, ways[1] / dt
        for velocity, previous, fastest, most in zip(self.velocity, last, FASTEST, STRONGEST, strict=True):
            assert math.hypot(*velocity) <= fastest * (1 + 1e-6) + 1e-9
            assert math.dist(velocity, previous) <= most * dt * (1 + 1e-6) + 1e-6
        assert np.abs(after.rotation.T @ after.rotation - np.eye(3)).max() < 1e-12
        return after


def moving() -> Watched:
    """Return a guard that follows a target at 0.4 m/s."""
    watched = Watched()
    for step in range(1, 101):
        watched.step(pose(0.4 * DT * step))
    assert watched.velocity[0][0] == pytest.approx(0.4, abs=0.01)
    return watched


def circle(t: float, radius: float, period: float) -> pin.SE3:
    """Return the pose at ``t`` [s] on a circle through the origin, which turns to and fro while it moves.

    The motion accelerates for half a second.
    """
    phase = 2 * math.pi / period * (t * t if t < 0.5 else t - 0.25)
    return pose(radius * (math.cos(phase) - 1), radius * math.sin(phase), 0.0, (0.0, 0.0, 0.5 * math.sin(phase)))


def test_a_braking_motion_is_dropped_after_a_gap_that_was_long_enough_for_it_to_end() -> None:
    watched = moving()
    held = watched.pose
    assert watched.step(None, 1.01 * LONGEST_DT).isApprox(held, 1e-12)
    assert watched.guard.at_rest
    assert watched.step(None).isApprox(held, 1e-12)


def test_the_first_pose_is_the_pose_of_the_reset_and_stays_while_the_clock_does_not_advance() -> None:
    start = pose(0.3, -0.2, 0.7, (0.1, 2.0, -0.4))
    watched = Watched(start)
    first = watched.step(start)
    np.testing.assert_allclose(first.homogeneous, start.homogeneous, atol=1e-12)
    for now in (watched.now, watched.now - 1.0, math.nan):
        assert watched.guard.step(pose(0.2), now) is first


def test_a_motion_within_the_limits_is_followed_without_lag() -> None:
    watched = Watched()
    for tick in range(1, 800):
        target = circle(tick * DT, 0.1, 3.0)
        after = watched.step(target)
        np.testing.assert_allclose(after.homogeneous, target.homogeneous, atol=1e-9)
    assert watched.guard.clipped == 0


@pytest.mark.parametrize("dt", [0.002, 0.02])
def test_a_jump_is_followed_without_overshoot_in_the_time_that_the_limits_require(dt: float) -> None:
    watched, goal = Watched(period=dt), pose(0.4, 0.0, 0.0, (0.0, 0.0, 1.0))
    fastest = 0.4 / LIMITS.max_velocity + LIMITS.max_velocity / LIMITS.max_acceleration
    steps, held_back = math.ceil(fastest / dt) + 4, 0
    for _ in range(steps):
        held_back += 0.4 - watched.pose.translation[0] > LIMITS.max_velocity * dt
        after = watched.step(goal, dt)
        assert after.translation[0] <= 0.4 + 1e-9
        assert pin.log3(after.rotation)[2] <= 1.0 + 1e-9
    np.testing.assert_allclose(after.homogeneous, goal.homogeneous, atol=1e-6)
    assert 0 < held_back <= watched.guard.clipped <= steps


def test_without_a_target_the_guarded_pose_brakes_and_stays_at_rest() -> None:
    watched = moving()
    for _ in range(math.ceil(0.4 / LIMITS.max_acceleration / DT) + 1):
        watched.step(None)
    assert watched.guard.at_rest
    rest = watched.pose
    for _ in range(20):
        np.testing.assert_array_equal(watched.step(None).homogeneous, rest.homogeneous)


@pytest.mark.parametrize("entry", [(0, 3), (2, 1)], ids=["of its position", "of its rotation"])
def test_a_target_with_one_number_that_is_not_finite_is_refused(entry: tuple[int, int]) -> None:
    watched, matrix = moving(), pose(0.1, 0.0, 0.0, (0.3, -2.0, 1.0)).homogeneous
    matrix[entry] = math.nan
    for _ in range(50):
        watched.step(pin.SE3(matrix[:3, :3], matrix[:3, 3]))
    assert watched.guard.at_rest


Coordinate = st.floats(-2.0, 2.0)
Target = st.none() | st.tuples(*[Coordinate] * 6)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(Target, st.integers(1, 30), st.sampled_from([0.001, 0.01, 0.013, 0.1, 1.0])), max_size=8))
def test_for_every_sequence_of_targets_all_limits_are_kept(
    sequence: list[tuple[tuple[float, ...] | None, int, float]],
) -> None:
    watched = Watched()
    for numbers, ticks, dt in sequence:
        target = None if numbers is None else pin.exp6(np.array(numbers))
        for _ in range(ticks):
            watched.step(target, dt)
    for _ in range(60):
        watched.step(None)
    assert watched.guard.at_rest


def test_if_limits_are_lowered_during_motion_the_pose_brakes_to_them_at_the_allowed_acceleration() -> None:
    watched, velocities = Watched(), []
    for tick in range(1, 121):
        if tick == 41:
            watched.guard.change(LIMITS.model_copy(update={"max_velocity": 0.1}))
        watched.step(pose(0.4 * DT * tick))
        velocities.append(watched.velocity[0][0])
    assert velocities[39] == pytest.approx(0.4)
    assert velocities[-1] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("gaps", "missed"),
    [
        pytest.param([1.0] * 9, 0, id="punctual ticks"),
        pytest.param([1.6, 0.4] * 100, 0, id="ticks that are only late"),
        pytest.param([1.6, 0.6, 0.8] * 100, 0, id="a late tick and two that catch up"),
        pytest.param([10.0, 0.1, 0.9], 8, id="a stall after which one tick is made up"),
        pytest.param([3.0, 1.0, 2.0], 3, id="ticks that never came"),
        pytest.param([1.0001] * 30_000, 0, id="a clock that runs differently"),
    ],
)
def test_only_ticks_that_never_came_count_as_missed(gaps: list[float], missed: int) -> None:
    pacer = TickPacer(PERIOD, LIMIT, ACCELERATION)
    for gap in gaps:
        pacer.step(gap * PERIOD, np.zeros_like(LIMIT))
    assert pacer.missed_ticks == missed
