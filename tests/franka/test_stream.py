"""Commands keep the published limits for every path, and whichever commands are lost."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from q2r2_franka import limits, stream
from q2r2_franka.check import Checked, check_commands
from q2r2_franka.limits import JOINTS, PERIOD
from q2r2_franka.record import Entry, entries_of, write_entry
from q2r2_franka.stream import PositionStream, TorqueStream

from q2r2_control.types import Array

MIDDLE = 0.5 * (limits.LOWER + limits.UPPER)


def restless_path(acceleration: float, random: np.random.Generator, count: int = 3000) -> Iterator[Array]:
    """Yield positions 1 ms apart (7,) [rad], whose acceleration jumps from one bound to the other at any time."""
    q, v, a = MIDDLE.copy(), np.zeros(JOINTS), np.zeros(JOINTS)
    for _ in range(count):
        jumps = random.random(JOINTS) < 0.1
        a = np.where(jumps, random.choice([-acceleration, 0.0, acceleration], JOINTS), a)
        a = np.where(np.abs(v) > 0.5, -acceleration * np.sign(v), a)
        q, v = q + v * PERIOD + 0.5 * a * PERIOD**2, v + a * PERIOD
        yield q


def checked(entries: list[Entry]) -> Checked:
    begin = Entry(0, True, entries[0].is_torque, 1, 0.0, MIDDLE if not entries[0].is_torque else np.zeros(JOINTS))
    return check_commands([begin, *entries])["left"]


def test_positions_keep_the_jerk_limit_even_if_the_acceleration_jumps_by_twice_its_limit() -> None:
    sent = PositionStream(MIDDLE)
    path = list(restless_path(limits.ACCELERATION, np.random.default_rng(1)))
    assert checked([Entry(0, False, False, 1, 0.0, sent.next([q])) for q in path]).violated == []
    # The path itself violates the jerk limit, which the check reports.
    assert checked([Entry(0, False, False, 1, 0.0, q) for q in path]).violated == ["jerk"]


@pytest.mark.parametrize("lost", [1, 2, 5, 15])
def test_if_a_robot_got_no_commands_it_comes_back_to_the_path_within_the_limits(lost: int) -> None:
    random = np.random.default_rng(lost)
    sent, entries, passed = PositionStream(MIDDLE), list[Entry](), list[Array]()
    for i, q in enumerate(restless_path(2.0, random)):
        passed.append(q)
        if i % 200 >= lost:
            entries.append(Entry(0, False, False, len(passed), 0.0, sent.next(passed)))
            passed = []
    result = checked(entries)
    assert result.violated == []
    assert result.lost == lost * 15


def test_a_command_equals_the_mean_of_positions_again_some_time_after_lost_commands() -> None:
    path = list(restless_path(2.0, np.random.default_rng(2), 400))
    all_heard, some_lost = PositionStream(MIDDLE), PositionStream(MIDDLE)
    expected = [all_heard.next([q]) for q in path]
    some_lost.next(path[:1])
    found = [some_lost.next(path[1:11]), *(some_lost.next([q]) for q in path[11:])]
    assert np.abs(found[0] - expected[10]).max() > 1e-7
    np.testing.assert_allclose(found[150], expected[160], rtol=0.0, atol=1e-12)


def test_torques_change_no_faster_than_the_robot_allows() -> None:
    random = np.random.default_rng(3)
    sent = TorqueStream(limits.TORQUE)
    wanted = [300.0 * random.standard_normal(JOINTS) for _ in range(1000)]
    result = checked([Entry(0, False, True, 1, 0.0, sent.next(tau)) for tau in wanted])
    assert result.violated == []
    assert result.shares["torque"] == pytest.approx(1.0)
    assert checked([Entry(0, False, True, 1, 0.0, tau) for tau in wanted]).violated == ["torque", "torque rate"]


def test_a_velocity_near_a_position_limit_is_checked_against_the_smaller_velocity_limit_there() -> None:
    speed = 1.0  # [rad/s]
    path = [MIDDLE + (limits.UPPER - MIDDLE - 0.05) * [1, 0, 0, 0, 0, 0, 0]]
    path += [path[0] + speed * PERIOD * i * np.eye(JOINTS)[0] for i in range(1, 20)]
    entries = [Entry(0, True, False, 1, 0.0, path[0]), *(Entry(0, False, False, 1, 0.0, q) for q in path)]
    assert "velocity" in check_commands(entries)["left"].violated
    assert speed < limits.VELOCITY[0]


def test_recorded_commands_are_read_as_they_were_written(tmp_path: Path) -> None:
    file = tmp_path / "commands.bin"
    entries = [Entry(1, True, False, 1, 2.5, MIDDLE), Entry(1, False, False, 3, 2.503, MIDDLE + 0.1)]
    with file.open("wb") as opened:
        for entry in entries:
            write_entry(opened, entry)
        opened.write(b"an entry that a killed process did not end")
    for read, written in zip(entries_of(file), entries, strict=True):
        assert read[:-1] == written[:-1]
        np.testing.assert_array_equal(read.values, written.values)


def test_the_number_of_averaged_positions_is_large_enough_for_the_jerk_limit() -> None:
    assert 2.0 * limits.ACCELERATION / (stream.MEANS * PERIOD) <= limits.JERK
