"""Messages of a frozen sender are found by their delay, and two publishers by the numbers of their messages."""

from __future__ import annotations

import math

import numpy as np
import pytest

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.supervision.targets import DelayWatch, SequenceWatch

ALLOWED, PERIOD, USUAL = 0.15, 0.01, 0.0004  # [s]


class Stream:
    """Messages of a sender whose clock is ahead by ``offset`` [s] and gains ``drift`` seconds a second."""

    def __init__(self, offset: float, drift: float = 0.0) -> None:
        self._watch, self.offset, self._drift = DelayWatch(ALLOWED), offset, drift
        self.now = 100.0

    def take(self, extra: float = 0.0, after: float = PERIOD) -> float:
        self.now += after
        ahead = self.offset + self._drift * (self.now - 100.0)
        return self._watch.take(USUAL + extra - ahead, self.now)


@pytest.mark.parametrize("offset", [0.0, 3600.0, -3600.0])
def test_only_the_message_that_a_frozen_sender_finishes_is_late(offset: float) -> None:
    stream = Stream(offset)
    assert not any(stream.take() for _ in range(100))
    assert stream.take(extra=1.0, after=1.0) == pytest.approx(1.0, abs=2e-3)
    assert not any(stream.take() for _ in range(100))


def test_a_message_that_waits_on_the_network_for_less_than_is_allowed_is_used() -> None:
    stream, random = Stream(0.0), np.random.default_rng(3)
    assert not any(stream.take(extra=extra) for extra in random.uniform(0.0, 0.9 * ALLOWED, 1000))


@pytest.mark.parametrize("drift", [1e-4, -1e-4])
def test_clocks_that_drift_apart_for_a_day_make_no_message_late(drift: float) -> None:
    stream = Stream(0.0, drift)
    assert not any(stream.take(after=60.0) for _ in range(24 * 60))


@pytest.mark.parametrize("by", [-5.0, 5.0])
def test_after_a_clock_was_set_messages_are_used_again_within_little_more_than_a_second(by: float) -> None:
    stream = Stream(0.0)
    assert not any(stream.take() for _ in range(100))
    stream.offset += by
    late = [stream.take() > 0.0 for _ in range(200)]
    assert any(late) == (by < 0.0)
    assert not any(late[105:])


def test_where_the_middleware_knows_no_delay_no_message_is_late_and_none_that_is_known_becomes_so() -> None:
    watch = DelayWatch(ALLOWED)
    assert [watch.take(delay, now) for now, delay in enumerate((-math.inf, USUAL, math.nan, USUAL))] == [0.0] * 4


def breaks(numbers: list[int]) -> list[int]:
    watch = SequenceWatch()
    return [watch.take(number, PERIOD * index, STREAM_TIMEOUT) for index, number in enumerate(numbers)]


@pytest.mark.parametrize("other", [1, 205, 90_000], ids=["younger", "almost in step", "older"])
def test_two_publishers_that_take_turns_break_the_numbers_at_the_third_message_and_again_at_the_fifth(
    other: int,
) -> None:
    found = breaks([number for step in range(20) for number in (200 + step, other + step)])
    assert found[2] >= 1
    assert all(count >= 2 for count in found[4:])


def test_one_publisher_may_lose_numbers_and_one_that_takes_over_is_one_break_and_forgotten_after_a_while() -> None:
    assert not any(breaks([7, 8, 9, 20, 21, 60, 61]))
    found = breaks([*range(500, 520), *range(1, 150)])
    assert found[19:21] == [0, 1]
    assert max(found) == 1
    assert found[-1] == 0


def test_numbers_begin_anew_after_a_silence_for_who_was_started_again() -> None:
    watch = SequenceWatch()
    for number in range(100):
        watch.take(number, PERIOD * number, STREAM_TIMEOUT)
    assert watch.take(1, PERIOD * 99 + STREAM_TIMEOUT + 0.01, STREAM_TIMEOUT) == 0
