"""Numbers of messages tell two publishers from one, and from one that was started again."""

from __future__ import annotations

import pytest

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.supervision.targets import SequenceWatch

PERIOD = 0.01  # [s]


def breaks(numbers: list[int], period: float = PERIOD) -> list[int]:
    watch = SequenceWatch()
    return [watch.take(number, period * index, STREAM_TIMEOUT) for index, number in enumerate(numbers)]


def test_rising_numbers_are_one_publisher_even_where_some_are_lost() -> None:
    assert not any(breaks([7, 8, 9, 20, 21, 60, 61]))


@pytest.mark.parametrize("other", [1, 205, 90_000], ids=["younger", "almost in step", "older"])
def test_two_publishers_that_take_turns_break_the_numbers_at_the_third_message_and_again_at_the_fifth(
    other: int,
) -> None:
    numbers = [number for step in range(20) for number in (200 + step, other + step)]
    found = breaks(numbers)
    assert found[2] >= 1
    assert all(count >= 2 for count in found[4:])


def test_one_that_takes_over_without_a_pause_is_one_break_and_forgotten_after_a_while() -> None:
    found = breaks([*range(500, 520), *range(1, 150)])
    assert found[19] == 0
    assert found[20] == 1
    assert max(found) == 1
    assert found[-1] == 0


def test_numbers_begin_anew_after_a_silence_for_who_was_started_again() -> None:
    watch = SequenceWatch()
    for number in range(100):
        watch.take(number, PERIOD * number, STREAM_TIMEOUT)
    assert watch.take(1, PERIOD * 99 + STREAM_TIMEOUT + 0.01, STREAM_TIMEOUT) == 0
