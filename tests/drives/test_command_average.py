"""Commands that are means of references keep the jerk limit and the other limits, and end at the last reference."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.control.controller import CartesianController
from q2r2_control.drives.base import make_drive
from q2r2_control.drives.command_average import CommandAverage
from q2r2_control.errors import ConfigError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, RobotState
from tests.support.hands_input import ENGAGED, HandsInput
from tests.support.processes import cell

A, H = 10.0, 0.001  # Acceleration limit [rad/s^2] and period [s].


def limited(jerk: object, mode: str = "position", **control: Any) -> Config:
    """Return the shipped cell with the jerk limit ``jerk`` [rad/s^3] and a loop of 1000 Hz."""
    settings = cell().control.model_copy(update={"jerk_limit": jerk, **control})
    return cell().model_copy(update={"control": settings, "loop_rate_hz": 1000.0})


def hasty_reference(ticks: int, dt: Array, seed: int = 1) -> list[tuple[Array, Array]]:
    """Return positions and velocities whose acceleration jumps from one limit to the other at random ticks."""
    random, q, v, a = np.random.default_rng(seed), np.zeros(2), np.zeros(2), np.full(2, A)
    path = []
    for h in dt[:ticks]:
        a = np.where(random.random(2) < 0.3, -a, a)
        q, v = q + h * v + 0.5 * h * h * a, v + h * a
        path.append((q, v))
    return path


@pytest.mark.parametrize("jerk", [700.0, 5000.0, 6000.0, 19_000.0])
def test_with_regular_ticks_commands_use_the_jerk_limit_fully_and_never_exceed_it(jerk: float) -> None:
    average = CommandAverage(2.0 * A / jerk, H)
    average.reset(np.zeros(2))
    commands = [average.update(q, v, H)[0] for q, v in hasty_reference(3000, np.full(3000, H))]
    acceleration = np.diff(commands, n=2, axis=0) / H**2
    largest = float(np.abs(np.diff(acceleration, axis=0) / H).max())
    count = math.ceil(2.0 * A / jerk / H - 1e-9)  # The window is a whole number of periods.
    assert largest <= jerk * (1.0 + 1e-6)
    assert largest == pytest.approx(2.0 * A / (count * H), rel=1e-3)
    assert float(np.abs(acceleration).max()) <= A * (1.0 + 1e-6)


def test_the_commanded_velocity_is_the_mean_of_the_last_velocities_of_the_reference() -> None:
    average = CommandAverage(0.004, H)
    average.reset(np.zeros(2))
    path = hasty_reference(50, np.full(50, H))
    commanded = [average.update(q, v, H)[1] for q, v in path]
    assert commanded[-1] == pytest.approx(np.mean([v for _, v in path[-4:]], axis=0), abs=1e-12)


def test_a_reference_that_rests_is_commanded_exactly_after_one_averaging_window() -> None:
    average, rest = CommandAverage(0.003, H), np.array([0.1, math.pi / 7])
    average.reset(np.zeros(2))
    for expected in (False, False, True, True):
        q, v = average.update(rest, np.zeros(2), H)
        assert average.settled == expected
    assert (q == rest).all()
    assert not v.any()


def test_a_tick_of_zero_duration_changes_no_command() -> None:
    average = CommandAverage(0.004, H)
    average.reset(np.zeros(2))
    for q, v in hasty_reference(20, np.full(20, H)):
        before, _ = average.update(q, v, H)
        again, _ = average.update(q, v, 0.0)
        assert (before == again).all()


@pytest.mark.parametrize("seed", range(3))
def test_with_irregular_ticks_commands_stay_within_the_allowed_distance_from_the_references_path(seed: int) -> None:
    window = 0.004
    dt = np.random.default_rng(seed).uniform(0.3 * H, 1.5 * H, 2000)
    average = CommandAverage(window, H)
    average.reset(np.zeros(2))
    path = hasty_reference(len(dt), dt, seed)
    times = np.cumsum(dt)
    for k, (q, v) in enumerate(path):
        command, _ = average.update(q, v, dt[k])
        if k < 20:
            continue
        centre = times[k] - average.delay
        after = int(np.searchsorted(times, centre))
        since, (start, start_v), (_, end_v) = centre - times[after - 1], path[after - 1], path[after]
        there = start + since * start_v + 0.5 * since**2 * (end_v - start_v) / dt[after]
        assert np.abs(command - there).max() <= 0.25 * A * window**2


def test_after_a_late_tick_the_reference_itself_is_commanded_and_averaging_starts_again() -> None:
    average = CommandAverage(0.004, H)
    average.reset(np.zeros(2))
    for q, v in hasty_reference(20, np.full(20, H)):
        average.update(q, v, H)
    late, v = q + 0.01, v + 0.02
    assert (average.update(late, v, 0.01)[0] == late).all()
    following, _ = average.update(late + 0.004, v, H)
    assert following == pytest.approx(late + 0.001, abs=1e-12)


def state_at(q: Array) -> RobotState:
    return RobotState(q, np.zeros_like(q), np.zeros_like(q), None, 0.0)


@pytest.mark.parametrize("mode", [CommandMode.POSITION, CommandMode.VELOCITY])
def test_a_drive_is_at_rest_only_when_its_last_command_is_the_reference(mode: CommandMode) -> None:
    config = limited(5000.0)
    robot = Robot.from_config(config)
    drive = make_drive(mode, robot, config)
    drive.average(H)
    drive.reset(state_at(robot.home))
    moved = robot.home + 1e-4
    reference = replace(CartesianController(robot, config.control.timed(realtime=False)).step({}, H), q=moved)
    commands: list[Array] = []
    while not drive.at_rest(state_at(moved)) or not commands:
        commands.append(drive.command(reference, state_at(moved), {}, H).q)
    assert len(commands) == 4
    assert (commands[-1] == moved).all()
    assert (commands[0] < moved).all()


def hasty(t: float) -> Array:
    """Return the pose (6,) of a hand that shakes so fast that the reference needs its whole acceleration limit."""
    return np.array([0.0, 0.0, 0.1 * math.sin(12.0 * max(t - ENGAGED, 0.0)), 0.0, 0.0, 0.0])


@pytest.mark.parametrize("mode", [CommandMode.POSITION, CommandMode.VELOCITY])
def test_a_whole_run_keeps_the_jerk_limit_in_every_tick(mode: CommandMode) -> None:
    jerk = 3000.0
    loop = Pipeline.from_config(limited(jerk), input=HandsInput(left=hasty, right=hasty), plant="kinematic", mode=mode)
    commands: list[Command] = []
    loop.listeners.append(lambda tick: commands.append(tick.command))
    loop.run(1.0, realtime=False)
    q = np.array([command.q for command in commands])
    assert np.ptp(q, axis=0).max() > 0.1
    assert np.abs(np.diff(q, n=3, axis=0) / H**3).max() <= jerk * (1.0 + 1e-3)
    assert np.abs(np.diff(q, n=3, axis=0) / H**3).max() > 0.5 * jerk


def test_in_torque_mode_a_jerk_limit_does_not_increase_the_distances_that_pairs_keep() -> None:
    loop = Pipeline.from_config(limited(5000.0), input=HandsInput(), plant="mujoco", mode="torque")
    plain = Pipeline.from_config(limited(None), input=HandsInput(), plant="mujoco", mode="torque")
    assert (loop.controller.kept_distances == plain.controller.kept_distances).all()


def test_a_jerk_limit_is_refused_if_the_plant_executes_its_own_stops_and_does_not_average_commands() -> None:
    config = load_config("config/dual_iiwa7_fri.yaml")
    config = config.model_copy(update={"control": config.control.model_copy(update={"jerk_limit": 5000.0})})
    with pytest.raises(ConfigError, match=r"control.jerk_limit: allowed: null, since FriPlant does not keep it"):
        Pipeline.from_config(config, input=HandsInput(), plant="fri")
