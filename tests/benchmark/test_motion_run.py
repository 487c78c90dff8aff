"""The figures of a work motion are right, and the bench gives our controller and its peers the same motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.benchmark.motion_run import (
    DT,
    MotionFigures,
    OwnController,
    play_motion,
    run_bench,
    run_motion,
)
from q2r2_control.benchmark.peers.base import INSTALL, PEERS, Leading
from q2r2_control.benchmark.work_motions import WORK_MOTIONS, motions_named
from q2r2_control.config.cell_file import load_config
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

CONFIG = load_config("config/dual_iiwa7.yaml")
SHORT = replace(
    WORK_MOTIONS["stretch"],
    name="short",
    duration=0.2,
    path=lambda t, home: home + np.array([[0.05 * t, 0.0, 0.0], [0.0, 0.0, 0.0]]),
)


class Standing:
    """A controller that stands still. On request, a joint moves in one tick, and one tick has no solution."""

    name, limitations = "standing", "everything"

    def __init__(self, jerked: int = -1, failing: int = -1, raises: bool = True) -> None:
        self._jerked, self._failing, self._raises = jerked, failing, raises

    def reset(self, q: Array) -> None:
        self._q, self._tick = q, -1
        self.given: list[pin.SE3] = []  # Targets of the left tool.

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        self.given.append(targets["left"])
        self._tick += 1
        if self._tick == self._failing and self._raises:
            raise RuntimeError("no solution")
        if self._tick == self._failing:
            return np.full(len(self._q), np.nan), np.zeros(len(self._q))
        v = np.zeros(len(self._q))
        v[3] = 0.002 if self._tick == self._jerked else 0.0
        return self._q.copy(), v

    def hold(self) -> tuple[Array, Array]:
        return self._q.copy(), np.zeros(len(self._q))


def test_for_a_controller_without_motion_the_figures_equal_figures_that_are_computed_from_its_targets(
    robot: Robot,
) -> None:
    ends = round(SHORT.ends / DT)
    figures = run_motion(Standing(jerked=ends - 100, failing=ends - 50), robot, SHORT)
    # The target moves by 10 mm at a constant speed, so the root mean square of the error is 10 / sqrt(3).
    assert figures.rms_error_mm == pytest.approx(10.0 / np.sqrt(3.0), rel=0.01)
    assert figures.max_error_mm == pytest.approx(10.0, rel=0.01)
    assert figures.end_error_mm == pytest.approx(10.0)
    assert figures.arrival_s is None
    assert figures.max_acceleration == pytest.approx(2.0)
    # In two of the last 500 ticks, one joint accelerates: first from rest to 0.002 rad/s, then back to rest.
    assert figures.rest_acceleration == pytest.approx(np.sqrt(2.0 * 2.0**2 / 500.0))
    assert (figures.done, figures.failures, figures.fallback_percent) == (1.0, 1, None)
    nearest = min(robot.distances(robot.home), key=lambda pair: pair.distance)
    assert figures.min_distance_mm == pytest.approx(1e3 * nearest.distance)
    assert figures.closest_pair == (nearest.name_a, nearest.name_b)


@pytest.mark.parametrize("raises", [True, False])
def test_the_arms_stand_still_in_a_tick_without_a_solution(robot: Robot, raises: bool) -> None:
    run = play_motion(Standing(failing=3, raises=raises), robot, SHORT, np.inf, DT)
    assert np.flatnonzero(run.failed).tolist() == [3]
    assert (run.q[3] == run.q[2]).all()
    assert not run.v[3].any()


def test_the_figures_do_not_contain_events_during_the_approach(robot: Robot) -> None:
    began = round(SHORT.begins / DT)
    figures = run_motion(Standing(jerked=began - 100, failing=began - 50), robot, SHORT)
    assert (figures.max_acceleration, figures.failures) == (0.0, 0)


@pytest.mark.slow
@pytest.mark.parametrize(("goal", "arrival"), [(0.0099, 0.0), (0.0101, None)])
def test_a_tool_within_10_mm_of_the_goal_has_arrived(robot: Robot, goal: float, arrival: float | None) -> None:
    away = replace(SHORT, path=lambda t, home: home + np.array([[0.0, goal, 0.0], [0.0, 0.0, 0.0]]))
    assert run_motion(Standing(), robot, away).arrival_s == arrival
    assert run_motion(Standing(), robot, replace(away, has_goal=False)).arrival_s is None


def test_if_a_tool_leaves_the_goal_again_its_arrival_is_the_time_of_its_last_return(robot: Robot) -> None:
    way = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    there_and_back = replace(SHORT, path=lambda t, home: home + 0.2 * min(t, 0.2 - t) * way)
    figures = run_motion(OwnController(robot, CONFIG), robot, there_and_back)
    assert figures.max_error_mm is not None
    assert figures.arrival_s is not None
    assert 0.1 < figures.arrival_s < 0.4


def test_the_report_contains_the_fraction_of_the_motion_that_a_too_slow_controller_completed(robot: Robot) -> None:
    figures = run_motion(Standing(), robot, SHORT, patience=0.0)
    assert figures.done < 0.01
    assert figures == MotionFigures("short", "standing", figures.done)


@pytest.mark.slow
def test_the_bench_runs_our_controller_in_free_air_and_in_the_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PEERS, "missing", "no_such_package_anywhere")
    monkeypatch.setitem(PEERS, "broken", "json")
    said: list[str] = []
    report = run_bench(CONFIG, motions_named(["slide"]), ("missing", "broken"), 2, said.append)
    (row,) = report.rows
    (ours,) = row.figures
    turns = [(turn, name) for turn in (1, 2) for name in ("free air", "q2r2_control")]
    assert said == [f"slide (1 of 1), round {turn}, {name}" for turn, name in turns]
    assert report.notes[0] == f"missing: not installed; {INSTALL}"
    assert report.notes[1].startswith("broken: cannot be built for this cell: ModuleNotFoundError")
    assert ours.min_distance_mm is not None
    assert ours.min_distance_mm >= 1.0  # The nearest pair, a finger and an obstacle, has to keep a distance of 1 mm.
    assert row.free_air.rms_error_mm is not None
    assert ours.rms_error_mm is not None
    # In the cell, the table keeps the tool 10 mm above its target.
    assert row.free_air.rms_error_mm < 2.0 < 9.0 < ours.rms_error_mm
    assert ours.times_us is not None
    assert list(ours.times_us) == sorted(ours.times_us)
    assert (ours.motion, ours.controller) == ("slide", "q2r2_control")


def test_the_target_that_a_peer_gets_is_ahead_by_its_speed_divided_by_the_gain() -> None:
    peer = Standing()
    leading = Leading(peer, gain=8.0)
    leading.reset(np.ones(14))
    turn = np.array([0.0, 0.0, 0.001])
    for tick in range(3):
        pose = pin.SE3(pin.exp3(tick * turn), np.array([0.0004 * tick, 0.0, 0.1]))
        leading.step({"left": pose}, 0.001)
    assert peer.given[0].isApprox(pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1])), 1e-15)
    # The target moves at 0.4 m/s and 1 rad/s. In an eighth of a second, it moves by 0.05 m and 0.125 rad.
    np.testing.assert_allclose(peer.given[2].translation, [0.0008 + 0.05, 0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(pin.log3(peer.given[2].rotation), [0.0, 0.0, 0.002 + 0.125], atol=1e-12)
    assert (leading.hold()[0] == 1.0).all()
    leading.reset(np.ones(14))
    leading.step({"left": pose}, 0.001)
    assert peer.given[0].isApprox(pose, 1e-15)
