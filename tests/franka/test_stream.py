"""Commands keep the published limits for every path, and whichever commands are lost."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from q2r2_franka import limits, stream
from q2r2_franka.check import Checked, check_commands, main
from q2r2_franka.limits import JOINTS, PERIOD
from q2r2_franka.record import Entry, entries_of, write_entry
from q2r2_franka.stream import PositionStream, TorqueStream

from q2r2_control.types import Array

MIDDLE = 0.5 * (limits.LOWER + limits.UPPER)
ACCELERATION = 4.8  # Largest acceleration of the cell [rad/s^2].


class Robot:
    """A robot as Franka describes it: in a period without a command in time, it keeps its last acceleration."""

    def __init__(self) -> None:
        self.positions = [MIDDLE] * 3
        self.jerk = 0.0  # Greatest jerk of a command so far [rad/s^3].
        self.acceleration = 0.0  # Greatest acceleration of a command so far [rad/s^2].

    @property
    def held(self) -> Array:
        return self.positions[-1]

    def move(self, command: Array | None) -> None:
        """Move for one period, by a command that came in time, or without a command."""
        oldest, before, newest = self.positions
        if command is None:
            command = 3.0 * newest - 3.0 * before + oldest
        else:
            jerk = (command - 3.0 * newest + 3.0 * before - oldest) / PERIOD**3
            self.jerk = max(self.jerk, float(np.abs(jerk).max()))
            acceleration = (command - 2.0 * newest + before) / PERIOD**2
            self.acceleration = max(self.acceleration, float(np.abs(acceleration).max()))
        self.positions = [before, newest, command]


def follow(robot: Robot, path: list[Array], kinds: list[str], *, told: bool = True) -> list[Array]:
    """Let a robot follow a path, whose commands are ``in time``, ``late``, or ``not sent``. Returns its positions.

    If ``told`` is False, the robot reports the last command instead of its own position.
    """
    sent, last, passed, found = PositionStream(MIDDLE), MIDDLE, list[Array](), list[Array]()
    for q, kind in zip(path, kinds, strict=True):
        passed.append(q)
        if kind == "not sent":
            robot.move(None)
        else:
            last = sent.next(passed, robot.held if told else last)
            passed = []
            robot.move(last if kind == "in time" else None)
        found.append(robot.held)
    return found


def mishaps(random: np.random.Generator, count: int) -> list[str]:
    """Return what happens to the commands of a stream: every 50 to 150 ms, some in a row are late or not sent."""
    kinds: list[str] = []
    while len(kinds) < count:
        kinds += ["in time"] * int(random.integers(50, 150))
        kinds += list(random.choice(["late", "not sent"], int(random.integers(1, 6))))
    return kinds[:count]


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
    begins = MIDDLE if not entries[0].is_torque else np.zeros(JOINTS)
    begin = Entry(0, True, entries[0].is_torque, 1, 0.0, begins, begins)
    return check_commands([begin, *entries])["left"]


def test_positions_keep_the_jerk_limit_even_if_the_acceleration_jumps_by_twice_its_limit() -> None:
    sent = PositionStream(MIDDLE)
    path = list(restless_path(limits.ACCELERATION, np.random.default_rng(1)))
    commands: list[Array] = []
    for q in path:
        commands.append(sent.next([q], commands[-1] if commands else MIDDLE))
    assert checked(positions_in_time(commands)).violated == []
    assert checked(positions_in_time(path)).violated == ["jerk"]  # The check finds that the path violates it.


def positions_in_time(commands: list[Array]) -> list[Entry]:
    """Return the record of commands that all came in time."""
    return [Entry(0, False, False, 1, 0.0, q, before) for q, before in zip(commands, [MIDDLE, *commands], strict=False)]


@pytest.mark.parametrize("seed", range(4))
def test_no_limit_is_violated_although_the_robot_drops_late_commands_and_some_commands_are_not_sent(seed: int) -> None:
    random, robot = np.random.default_rng(seed), Robot()
    path = list(restless_path(ACCELERATION, random))
    follow(robot, path, mishaps(random, len(path)))
    assert 1200.0 < robot.jerk <= limits.JERK
    assert robot.acceleration <= limits.ACCELERATION


def test_late_commands_violate_the_jerk_limit_if_the_robot_does_not_say_where_it_is() -> None:
    violated = 0
    for seed in range(4):
        random, robot = np.random.default_rng(seed), Robot()
        path = list(restless_path(ACCELERATION, random))
        follow(robot, path, mishaps(random, len(path)), told=False)
        violated += robot.jerk > limits.JERK
    assert violated >= 3


def test_a_single_late_command_violates_no_limit_even_if_the_robot_does_not_say_where_it_is() -> None:
    random, robot = np.random.default_rng(5), Robot()
    path = list(restless_path(ACCELERATION, random))
    follow(robot, path, ["late" if i % 40 == 39 else "in time" for i in range(len(path))], told=False)
    assert 2400.0 < robot.jerk <= limits.JERK


@pytest.mark.parametrize("mishap", ["late", "not sent"])
def test_a_robot_is_on_the_path_again_some_time_after_lost_commands(mishap: str) -> None:
    path = list(restless_path(2.0, np.random.default_rng(2), 400))
    expected = follow(Robot(), path, ["in time"] * len(path))
    found = follow(Robot(), path, ["in time", *[mishap] * 10, *["in time"] * (len(path) - 11)])
    assert np.abs(found[11] - expected[11]).max() > 1e-7
    np.testing.assert_allclose(found[160], expected[160], rtol=0.0, atol=1e-12)


def test_the_check_finds_a_command_that_follows_a_dropped_command_too_abruptly() -> None:
    path = list(restless_path(ACCELERATION, np.random.default_rng(1), 300))
    robot, entries = Robot(), list[Entry]()
    for i, q in enumerate(follow(Robot(), path, ["in time"] * len(path))):
        entries.append(Entry(0, False, False, 1, 0.0, q, robot.held))
        robot.move(q if i % 30 < 28 else None)
    result = checked(entries)
    assert "jerk" in result.violated
    assert result.lost == pytest.approx(20, abs=2)


def test_torques_change_no_faster_than_the_robot_allows_even_if_the_robot_drops_some_torques() -> None:
    random = np.random.default_rng(3)
    sent, held, entries = TorqueStream(limits.TORQUE), np.zeros(JOINTS), list[Entry]()
    wanted = [300.0 * random.standard_normal(JOINTS) for _ in range(1000)]
    for tau in wanted:
        entries.append(Entry(0, False, True, 1, 0.0, sent.next(tau, held), held))
        held = held if random.random() < 0.2 else entries[-1].values
    result = checked(entries)
    assert result.violated == []
    assert result.shares["torque rate"] == pytest.approx(1.0, abs=2e-3)
    raw = [Entry(0, False, True, 1, 0.0, tau, held) for tau, held in zip(wanted[1:], wanted, strict=False)]
    assert checked(raw).violated == ["torque", "torque rate"]


def test_a_command_that_is_no_number_violates_the_limits() -> None:
    path = np.tile(MIDDLE, (5, 1))
    path[3, 2] = np.nan
    assert "position" in checked(positions_in_time(list(path))).violated


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"", id="an empty file"),
        pytest.param(b"a text", id="a file that is shorter than an entry"),
        pytest.param(bytes(1000), id="a file without the beginning of a motion"),
        pytest.param(b"\xff" * 1000, id="a file with an arm that does not exist"),
    ],
)
def test_a_file_without_commands_does_not_pass_the_check(
    content: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (file := tmp_path / "commands.bin").write_bytes(content)
    assert main([str(file)]) == 2
    assert capsys.readouterr().err == (
        f"{file}: no commands, or an entry that cannot be read; allowed: a file of plant_settings.franka.record\n"
    )


def test_a_velocity_near_a_position_limit_is_checked_against_the_smaller_velocity_limit_there() -> None:
    speed = 1.0  # [rad/s]
    path = [MIDDLE + (limits.UPPER - MIDDLE - 0.05) * [1, 0, 0, 0, 0, 0, 0]]
    path += [path[0] + speed * PERIOD * i * np.eye(JOINTS)[0] for i in range(1, 20)]
    entries = [Entry(0, True, False, 1, 0.0, path[0], path[0])]
    entries += [Entry(0, False, False, 1, 0.0, q, held) for q, held in zip(path[1:], path, strict=False)]
    assert "velocity" in check_commands(entries)["left"].violated
    assert speed < limits.VELOCITY[0]


def test_recorded_commands_are_read_as_they_were_written(tmp_path: Path) -> None:
    file = tmp_path / "commands.bin"
    entries = [Entry(1, True, False, 1, 2.5, MIDDLE, MIDDLE), Entry(1, False, False, 3, 2.503, MIDDLE + 0.1, MIDDLE)]
    with file.open("wb") as opened:
        for entry in entries:
            write_entry(opened, entry)
        opened.write(b"an entry that a killed process did not end")
    for read, written in zip(entries_of(file), entries, strict=True):
        assert read[:-2] == written[:-2]
        np.testing.assert_array_equal(read[-2:], written[-2:])


def test_the_number_of_averaged_positions_is_large_enough_for_the_jerk_limit() -> None:
    assert 2.0 * limits.ACCELERATION / (stream.MEANS * PERIOD) <= limits.JERK
    assert 4.0 * 2.0 * ACCELERATION / (stream.MEANS * PERIOD) <= limits.JERK
