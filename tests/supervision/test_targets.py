"""Late messages and second publishers are noticed. Uniform motion stays uniform if sender and loop are not in step."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.supervision.target_stream import TargetExtrapolator
from q2r2_control.supervision.targets import DelayWatch, SequenceWatch
from q2r2_control.supervision.tick_pacer import TickClock

ALLOWED, PERIOD, USUAL = 0.15, 0.01, 0.0004  # [s]


class Stream:
    """Messages of a sender whose clock is ahead by ``offset`` [s] and gains ``drift`` seconds per second."""

    def __init__(self, offset: float, drift: float = 0.0) -> None:
        self._watch, self.offset, self._drift = DelayWatch(ALLOWED), offset, drift
        self.now = 100.0

    def take(self, extra: float = 0.0, after: float = PERIOD) -> float:
        self.now += after
        ahead = self.offset + self._drift * (self.now - 100.0)
        return self._watch.take(USUAL + extra - ahead, self.now)


@pytest.mark.parametrize("offset", [0.0, 3600.0, -3600.0])
def test_after_a_sender_was_frozen_only_its_first_message_counts_as_late(offset: float) -> None:
    stream = Stream(offset)
    assert not any(stream.take() for _ in range(100))
    assert stream.take(extra=1.0, after=1.0) == pytest.approx(1.0, abs=2e-3)
    assert not any(stream.take() for _ in range(100))


def test_a_message_that_waits_on_the_network_for_less_than_allowed_is_used() -> None:
    stream, random = Stream(0.0), np.random.default_rng(3)
    assert not any(stream.take(extra=extra) for extra in random.uniform(0.0, 0.9 * ALLOWED, 1000))


@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_clocks_that_drift_apart_for_a_day_make_no_message_late(drift: float) -> None:
    stream = Stream(0.0, drift)
    assert not any(stream.take(after=60.0) for _ in range(24 * 60))


@pytest.mark.parametrize("by", [-5.0, 5.0])
def test_after_a_change_of_a_clock_messages_are_used_again_within_little_more_than_a_second(by: float) -> None:
    stream = Stream(0.0)
    assert not any(stream.take() for _ in range(100))
    stream.offset += by
    late = [stream.take() > 0.0 for _ in range(200)]
    assert any(late) == (by < 0.0)
    assert not any(late[105:])


def test_if_the_middleware_tells_no_delay_no_message_counts_as_late() -> None:
    watch = DelayWatch(ALLOWED)
    assert [watch.take(delay, now) for now, delay in enumerate((-math.inf, USUAL, math.nan, USUAL))] == [0.0] * 4


def breaks(numbers: list[int]) -> list[int]:
    watch = SequenceWatch()
    return [watch.take(number, PERIOD * index, STREAM_TIMEOUT) for index, number in enumerate(numbers)]


@pytest.mark.parametrize("other", [1, 205, 90_000], ids=["younger", "almost in step", "older"])
def test_two_publishers_that_alternate_are_found_at_the_third_and_fifth_message(other: int) -> None:
    found = breaks([number for step in range(20) for number in (200 + step, other + step)])
    assert found[2] >= 1
    assert all(count >= 2 for count in found[4:])


def test_skipped_sequence_numbers_are_no_break_and_a_new_publisher_causes_one_break_which_later_expires() -> None:
    assert not any(breaks([7, 8, 9, 20, 21, 60, 61]))
    found = breaks([*range(500, 520), *range(1, 150)])
    assert found[19:21] == [0, 1]
    assert max(found) == 1
    assert found[-1] == 0


@pytest.mark.parametrize(("number", "found"), [(190, 0), (220, 1)], ids=["its own number", "another's number"])
def test_sequence_numbers_may_skip_at_most_as_many_messages_as_one_publisher_sends_in_a_tenth_of_a_second(
    number: int, found: int
) -> None:
    """The publisher sends at most 2000 messages in a second. All but the newest were lost while the network stalled."""
    watch = SequenceWatch()
    watch.take(1, 0.0, STREAM_TIMEOUT)
    assert watch.take(number, 0.001, STREAM_TIMEOUT) == found


def test_a_repeated_sequence_number_is_a_break_and_each_break_counts_for_one_second() -> None:
    watch = SequenceWatch()
    found = [watch.take(number, now, STREAM_TIMEOUT) for number, now in ((5, 0.0), (5, 0.1), (6, 0.2), (6, 0.3))]
    assert found == [0, 1, 1, 2]
    assert [watch.take(7 + k, 0.35 + 0.1 * k, STREAM_TIMEOUT) for k in range(12)] == [2] * 8 + [1, 1, 0, 0]


def test_sequence_numbers_that_start_again_after_a_silence_are_no_break() -> None:
    watch = SequenceWatch()
    for number in range(100):
        watch.take(number, PERIOD * number, STREAM_TIMEOUT)
    assert watch.take(1, PERIOD * 99 + STREAM_TIMEOUT + 0.01, STREAM_TIMEOUT) == 0


SENDER, LOOP = 0.005, 0.004  # Periods of the sender and of the loop [s].
SPEED, RADIUS = 0.3, 0.1  # Speed [m/s] and radius [m] of the circle on which the target moves.


def circling(t: float) -> pin.SE3:
    angle = SPEED / RADIUS * t
    where = np.array([0.5 + RADIUS * math.cos(angle), RADIUS * math.sin(angle), 0.4])
    return pin.SE3(pin.exp3(np.array([0.0, 0.0, angle])), where)


def played(pose: Callable[[float], pin.SE3], until: float, *, lines: bool, jitter: float = 4e-4) -> list[pin.SE3]:
    """Return the loop's target at each tick.

    The sender and the loop tick late by up to ``jitter`` [s]. A message takes 0.5 ms and up to ``jitter`` more.
    If ``lines`` is True, the time at which each target is due is known, so that targets are extrapolated.
    """
    random, line, clock = np.random.default_rng(0), TargetExtrapolator(), TickClock(LOOP)
    sent = [SENDER * k + random.uniform(0.0, jitter) for k in range(int(until / SENDER))]
    received = [t + 5e-4 + random.uniform(0.0, jitter) for t in sent]
    found, taken = [], 0
    for k in range(1, int(until / LOOP) - 1):
        now = LOOP * k + 1e-3 + random.uniform(0.0, jitter)
        while taken < len(sent) and received[taken] <= now:
            line.put(pose(sent[taken]), sent[taken] + 5e-4 if lines else None)
            taken += 1
        if (target := line.at(clock.at(now))) is not None:
            found.append(target)
    return found


def ripple(targets: list[pin.SE3]) -> float:
    """Return the RMS deviation of the speed from its mean, divided by the mean, after the start."""
    speeds = np.linalg.norm(np.diff([target.translation for target in targets[20:]], axis=0), axis=1)
    return float(np.std(speeds) / np.mean(speeds))


def test_a_uniform_motion_stays_uniform_only_with_extrapolation() -> None:
    assert ripple(played(circling, 3.0, lines=True)) < 0.02
    assert ripple(played(circling, 3.0, lines=False)) > 0.3


def test_extrapolated_targets_stay_on_the_path_of_the_targets() -> None:
    for found in played(circling, 3.0, lines=True)[10:]:
        middle = found.translation - np.array([0.5, 0.0, 0.4])
        assert np.linalg.norm(middle) == pytest.approx(RADIUS, abs=2e-4)
        angle = math.atan2(middle[1], middle[0])
        tilt = found.rotation[2, :2]
        assert np.abs(tilt).max() < 1e-9
        turned = math.remainder(pin.log3(found.rotation)[2] - angle, math.tau)
        assert abs(turned) < 2e-3


def test_a_jump_of_the_target_is_not_extrapolated_as_a_motion() -> None:
    line, low = TargetExtrapolator(), pin.SE3.Identity()
    high = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.002]))
    for k in range(20):
        due = k * SENDER
        line.put(high if k >= 10 else low, due)
        found = line.at(due + 0.8 * SENDER)
        assert found is not None
        assert found.translation[2] in (0.0, 0.002)


def test_a_uniform_turn_is_extrapolated_if_the_sender_is_as_slow_as_a_headset() -> None:
    line, period, velocity = TargetExtrapolator(), 1.0 / 72.0, np.array([0.3, -0.4, 0.5])  # [s], [rad/s]
    for k in range(5):
        line.put(pin.SE3(pin.exp3(velocity * k * period), np.zeros(3)), k * period)
    found = line.at(4.5 * period)
    assert found is not None
    np.testing.assert_allclose(pin.log3(found.rotation), 4.5 * period * velocity, atol=1e-9)


def test_a_motion_is_extrapolated_by_at_most_two_and_a_half_periods_of_the_sender() -> None:
    line, velocity = TargetExtrapolator(), np.array([0.3, 0.0, 0.0])
    for k in range(10):
        line.put(pin.SE3(np.eye(3), velocity * k * SENDER), k * SENDER)
    end = line.at(9 * SENDER + 1.0)
    assert end is not None
    assert end.translation[0] == pytest.approx(0.3 * (9 + 2.5) * SENDER)


@pytest.mark.parametrize("stamps", [[0.0] * 10, [5e-6 * k for k in range(10)], [0.1 * k for k in range(10)]])
def test_targets_with_useless_stamps_are_used_without_extrapolation(stamps: list[float]) -> None:
    line = TargetExtrapolator()
    for k, stamp in enumerate(stamps):
        target = circling(k * SENDER)
        line.put(target, stamp)
        assert line.at(stamp + 0.004) is target


def test_a_target_that_is_due_before_the_previous_target_is_used_without_extrapolation() -> None:
    line = TargetExtrapolator()
    for k in range(10):
        line.put(circling(k * SENDER), k * SENDER)
    line.put(circling(7 * SENDER), 7 * SENDER)
    older = circling(4 * SENDER)
    line.put(older, 4 * SENDER)
    assert line.at(5 * SENDER) is older


def test_a_new_stream_does_not_depend_on_the_previous_stream() -> None:
    line = TargetExtrapolator()
    for k in range(5):
        line.put(circling(k * SENDER), k * SENDER)
    line.reset()
    assert line.at(5 * SENDER) is None
    target = circling(1.0)
    line.put(target, 5 * SENDER)
    assert line.at(6 * SENDER) is target
