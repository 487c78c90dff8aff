"""The guard's promises at every tick: speed, acceleration, unit quaternions, rest; and no lag where it need not lag."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.config.teleop import GuardSettings
from q2r2_control.supervision.tick_pacer import PoseRateLimiter, TickPacer
from q2r2_control.types import LONGEST_DT
from tests.teleop.hands import pose

DT = 0.01
LIMITS = GuardSettings(max_velocity=0.5, max_acceleration=5.0, max_angular_velocity=2.0, max_angular_acceleration=20.0)


class Watched:
    """A guard whose every step is checked against its limits."""

    def __init__(self, start: pin.SE3 | None = None, period: float = DT) -> None:
        self.guard, self._period = PoseRateLimiter(LIMITS, period), period
        self.now = 5.0
        self.guard.reset(start or pose(), self.now)
        self.velocity = np.zeros(3), np.zeros(3)

    @property
    def pose(self) -> pin.SE3:
        assert self.guard.pose is not None
        return self.guard.pose

    def step(self, target: pin.SE3 | None, dt: float = DT) -> pin.SE3:
        if self.now + dt - self.now > LONGEST_DT:  # what follows it has come to rest
            self.velocity = np.zeros(3), np.zeros(3)
        before, last = self.pose, self.velocity
        self.now += dt
        after = self.guard.step(target, self.now)
        assert after is not None
        if dt > self._period:  # late: a step moves it by no more than a period allows
            for way, fastest in (
                (after.translation - before.translation, LIMITS.max_velocity),
                (pin.log3(after.rotation @ before.rotation.T), LIMITS.max_angular_velocity),
            ):
                assert math.hypot(*way) <= fastest * self._period * (1 + 1e-6) + 1e-9
            dt = self._time_moved(dt)
        self.velocity = (
            (after.translation - before.translation) / dt,
            pin.log3(after.rotation @ before.rotation.T) / dt,
        )
        bounds = (
            (LIMITS.max_velocity, LIMITS.max_acceleration),
            (LIMITS.max_angular_velocity, LIMITS.max_angular_acceleration),
        )
        for velocity, previous, (fastest, acceleration) in zip(self.velocity, last, bounds, strict=True):
            assert math.hypot(*velocity) <= fastest * (1 + 1e-6) + 1e-9
            assert math.dist(velocity, previous) <= acceleration * dt * (1 + 1e-6) + 1e-6
        assert np.abs(after.rotation.T @ after.rotation - np.eye(3)).max() < 1e-12
        return after

    def _time_moved(self, gap: float) -> float:
        """By how much time a late step moves it, from the velocities before."""
        limits = np.array([LIMITS.max_velocity, LIMITS.max_angular_velocity])
        accelerations = np.array([LIMITS.max_acceleration, LIMITS.max_angular_acceleration])
        speeds = np.array([math.hypot(*velocity) for velocity in self.velocity])
        return TickPacer(self._period, limits, 2.0 * accelerations).step(gap, speeds)


def circle(t: float, radius: float, period: float) -> pin.SE3:
    """A circle through the origin that sets off within half a second, turning on its way."""
    phase = 2 * math.pi / period * (t * t if t < 0.5 else t - 0.25)
    return pose(radius * (math.cos(phase) - 1), radius * math.sin(phase), 0.0, (0.0, 0.0, 0.5 * math.sin(phase)))


def test_what_was_left_to_brake_on_is_not_moved_after_a_gap_in_which_all_came_to_rest() -> None:
    watched = Watched()
    for step in range(1, 101):
        watched.step(pose(0.4 * DT * step))
    assert watched.velocity[0][0] == pytest.approx(0.4, abs=0.01)
    held = watched.pose
    assert watched.step(None, 1.01 * LONGEST_DT).isApprox(held, 1e-12)
    assert watched.guard.at_rest
    assert watched.step(None).isApprox(held, 1e-12)


def test_the_first_pose_is_that_of_the_reset_exactly() -> None:
    start = pose(0.3, -0.2, 0.7, (0.1, 2.0, -0.4))
    guard = PoseRateLimiter(LIMITS, DT)
    guard.reset(start, 5.0)
    first = guard.step(start, 5.0 + DT)
    assert first is not None
    np.testing.assert_allclose(first.homogeneous, start.homogeneous, atol=1e-12)


def test_a_motion_within_the_limits_is_followed_without_lag() -> None:
    watched = Watched()
    for tick in range(1, 800):
        target = circle(tick * DT, 0.1, 3.0)
        after = watched.step(target)
        np.testing.assert_allclose(after.homogeneous, target.homogeneous, atol=1e-9)
    assert watched.guard.clipped == 0


@pytest.mark.parametrize("dt", [0.002, 0.02])
def test_a_step_is_reached_without_overshoot_in_the_time_that_the_limits_take(dt: float) -> None:
    watched, goal = Watched(period=dt), pose(0.4, 0.0, 0.0, (0.0, 0.0, 1.0))
    fastest = 0.4 / LIMITS.max_velocity + LIMITS.max_velocity / LIMITS.max_acceleration
    for _ in range(math.ceil(fastest / dt) + 4):
        after = watched.step(goal, dt)
        assert after.translation[0] <= 0.4 + 1e-9
        assert pin.log3(after.rotation)[2] <= 1.0 + 1e-9
    np.testing.assert_allclose(after.homogeneous, goal.homogeneous, atol=1e-6)
    assert watched.guard.clipped > 0


def test_without_a_target_it_brakes_and_rests() -> None:
    watched = Watched()
    for tick in range(1, 100):
        watched.step(pose(0.004 * tick))
    assert math.hypot(*watched.velocity[0]) > 0.3
    for _ in range(math.ceil(0.4 / LIMITS.max_acceleration / DT) + 1):
        watched.step(None)
    assert watched.guard.at_rest
    rest = watched.pose
    for _ in range(20):
        np.testing.assert_array_equal(watched.step(None).homogeneous, rest.homogeneous)


@pytest.mark.parametrize("entry", [(0, 3), (2, 1)], ids=["of its position", "of its rotation"])
def test_a_target_with_one_number_that_is_not_finite_is_held_off(entry: tuple[int, int]) -> None:
    watched, matrix = Watched(), pose(0.1, 0.0, 0.0, (0.3, -2.0, 1.0)).homogeneous
    matrix[entry] = math.nan
    for tick in range(1, 50):
        watched.step(pose(0.004 * tick))
    for _ in range(50):
        watched.step(pin.SE3(matrix[:3, :3], matrix[:3, 3]))
    assert watched.guard.at_rest


def test_a_clock_that_does_not_advance_returns_the_same_pose() -> None:
    watched = Watched()
    watched.step(pose(0.1))
    before = watched.pose
    for now in (watched.now, watched.now - 1.0, math.nan):
        assert watched.guard.step(pose(0.2), now) is before


Coordinate = st.floats(-2.0, 2.0)
Target = st.one_of(st.none(), st.tuples(Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(Target, st.integers(1, 30), st.sampled_from([0.001, 0.01, 0.013, 0.1, 1.0])), max_size=8))
def test_no_sequence_of_targets_breaks_a_limit(
    sequence: list[tuple[tuple[float, ...] | None, int, float]],
) -> None:
    watched = Watched()
    for numbers, ticks, dt in sequence:
        target = None if numbers is None else pin.SE3(pin.exp3(np.array(numbers[3:])), np.array(numbers[:3]))
        for _ in range(ticks):
            watched.step(target, dt)
    for _ in range(60):
        watched.step(None)
    assert watched.guard.at_rest


def test_limits_that_are_lowered_in_motion_brake_the_pose_at_the_acceleration_and_count_from_then_on() -> None:
    guard, now, speed = PoseRateLimiter(LIMITS, DT), 5.0, 0.4
    guard.reset(pose(), now)
    way = np.array([speed * DT, 0.0, 0.0])
    target, velocities = pose(), [0.0]
    for tick in range(120):
        if tick == 40:
            guard.change(LIMITS.model_copy(update={"max_velocity": 0.1}))
        before, now = guard.pose, now + DT
        target = pin.SE3(target.rotation, target.translation + way)
        after = guard.step(target, now)
        assert before is not None
        assert after is not None
        velocities.append(math.dist(after.translation, before.translation) / DT)
    assert velocities[40] == pytest.approx(speed)
    assert velocities[-1] == pytest.approx(0.1)
    changes = np.abs(np.diff(velocities)) / DT
    assert changes.max() <= LIMITS.max_acceleration * (1.0 + 1e-9)
