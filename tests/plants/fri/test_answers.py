"""Answers to cabinets whose clocks drift, through networks that delay and lose messages, in virtual time."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.plants.fri.answers import CATCH_UP, CATCH_UP_RAMP, AnswerTimes, MessageClock, ReferencePath
from q2r2_control.types import Array

SPEED, ACCELERATION = 1.5, 9.0  # Largest speed [rad/s] and acceleration [rad/s^2] of the reference.
DELAY, TICK = 0.008, 0.001


def swing(t: float) -> tuple[Array, Array]:
    """Return the position [rad] and velocity [rad/s] of a swing that reaches the largest speed and acceleration."""
    w = ACCELERATION / SPEED
    return np.array([SPEED / w * (1.0 - np.cos(w * t))]), np.array([SPEED * np.sin(w * t)])


def answered(period: float, drift: float, jitter: float, loss: float, seed: int, duration: float = 30.0) -> Array:
    """Return the positions that the cabinet hears, one after the other."""
    random = np.random.default_rng(seed)
    path, times = ReferencePath(0.0, swing(0.0)[0]), AnswerTimes(period, DELAY)
    heard_positions, heard, ticks, clock, before = [], -1, 0, MessageClock(0.0), 0
    asked = np.arange(1, int(duration / period)) * period * (1.0 + drift)
    for question, sent in enumerate(asked):
        arrival = sent + random.uniform(0.0, jitter)
        while (ticks + 1) * TICK <= arrival:
            ticks += 1
            path.extend(ticks * TICK, *swing(ticks * TICK), np.array([ACCELERATION]))
        if random.random() < loss:
            continue  # The question is lost.
        clock.update(arrival, (question + 1 - before) * period)
        before = question + 1
        time = times.at(question, clock.expected, question, heard)
        assert time <= path.end, "nothing is extrapolated while our loop is on time"
        if random.random() < loss:
            continue  # The answer is lost.
        heard = question
        heard_positions.append(path.at(time)[0])
    return np.array(heard_positions)


CASES = {
    "a perfect network": (0.005, 0.0, 0.0, 0.0),
    "drift": (0.005, 200e-6, 0.0, 0.0),
    "drift the other way": (0.002, -200e-6, 0.0, 0.0),
    "jitter": (0.005, 0.0, 0.0025, 0.0),
    "loss": (0.005, 0.0, 0.0, 0.01),
    "everything": (0.005, 200e-6, 0.002, 0.005),
    "everything at 2 ms": (0.002, -200e-6, 0.001, 0.005),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", list(CASES))
def test_the_cabinet_sees_no_larger_speed_and_acceleration_than_documented(case: str) -> None:
    period = CASES[case][0]
    q = answered(*CASES[case], seed=3)
    v = np.diff(q) / period
    a = np.diff(v) / period
    assert np.abs(v).max() <= (1.0 + CATCH_UP) * SPEED * (1 + 1e-9)
    allowed = (1.0 + CATCH_UP) ** 2 * ACCELERATION + CATCH_UP_RAMP * SPEED
    assert np.abs(a[1:]).max() <= allowed * (1 + 1e-9)
    assert np.abs(q).max() > 0.4, "and the arm moves"


def test_an_answer_lags_by_at_most_the_delay_and_four_periods() -> None:
    period = 0.005
    times = AnswerTimes(period, DELAY)
    random, heard, late = np.random.default_rng(4), -1, []
    for question in range(4000):
        if random.random() < 0.005:
            continue
        arrival = (question + 1) * period * (1.0 + 200e-6)
        late.append(arrival - times.at(question, arrival, question, heard))
        heard = question
    assert DELAY - 1e-3 <= np.median(late[500:]) <= DELAY + period
    assert max(late[500:]) <= DELAY + 4 * period


def test_a_repeated_question_gets_an_answer_for_the_same_time() -> None:
    times = AnswerTimes(0.005, DELAY)
    for question in range(100):
        first = times.at(question, 0.005 * question, 2 * question, 2 * question - 1)
        again = times.at(question, 0.005 * question, 2 * question + 1, 2 * question - 1)
        assert abs(again - first) <= 1e-4


def test_the_path_ends_with_the_certified_stop_if_the_loop_stands_still() -> None:
    path = ReferencePath(0.0, np.zeros(2))
    path.extend(0.001, np.array([0.0005, -0.001]), np.array([1.0, -2.0]), np.array([10.0, 10.0]))
    t = 0.001 + np.linspace(0.0, 0.3, 301)
    q = np.array([path.at(one) for one in t])
    np.testing.assert_allclose(q[-1], [0.0505, -0.201], atol=1e-12)
    a = np.diff(q, n=2, axis=0) / 1e-6
    assert np.abs(a).max() <= 10.0 + 1e-6


def test_if_a_path_brakes_during_a_motion_the_certified_stop_begins_at_the_end_of_this_motion() -> None:
    path, certified = ReferencePath(0.0, np.zeros(2)), ReferencePath(0.0, np.zeros(2))
    for each in (path, certified):
        each.extend(0.01, np.array([0.0, 0.0]), np.array([1.0, 0.02]), np.array([5.0, 0.1]))
        # All joints stop together, so that the joint that almost rests hardly brakes.
        each.extend(0.02, np.array([0.01, 1e-4]), np.array([1.0, 1e-4]), np.array([5.0, 5e-4]))
    path.extend(0.03, np.array([0.02, 0.0]), np.array([1.0, -0.02]), np.array([5.0, 0.1]))
    path.brake(0.015)
    for t in np.linspace(0.0, 0.3, 61):
        np.testing.assert_array_equal(path.at(t), certified.at(t))
    np.testing.assert_allclose(path.at(0.02 + 0.2), path.rest, atol=1e-9)
    path.brake(0.1)
    np.testing.assert_array_equal(path.rest, certified.rest)


def test_between_two_ticks_the_posture_is_on_the_parabola_of_the_reference() -> None:
    path = ReferencePath(1.0, np.zeros(1))
    path.extend(1.1, np.array([0.05]), np.array([1.0]), np.ones(1))
    for t in (1.0, 1.025, 1.05, 1.1):
        np.testing.assert_allclose(path.at(t), 5.0 * (t - 1.0) ** 2, atol=1e-15)
    assert path.at(0.5) == 0.0


@pytest.mark.parametrize("lost", [10, 65, 300, 2000])
def test_after_many_lost_answers_the_next_answer_follows_the_last_answer_that_the_cabinet_heard(lost: int) -> None:
    period = 0.001
    times, heard = AnswerTimes(period, 0.004), -1
    for question in range(100):
        last = times.at(question, question * period, question, heard)
        heard = question
    for question in range(100, 100 + lost):
        time = times.at(question, question * period, question, heard)
        oldest_known = max(lost - 1024, 0) * (1.0 + CATCH_UP) * period
        assert 0.0 < time - last <= (1.0 + CATCH_UP) * period + oldest_known
