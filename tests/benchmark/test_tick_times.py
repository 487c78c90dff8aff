"""The bench measures all controllers in the same way, works without missing peers, and counts failures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.benchmark.peers.base import INSTALL, PEERS, is_installed
from q2r2_control.benchmark.tick_times import SCENARIOS, run_bench
from q2r2_control.benchmark.timed_run import Poses, metrics_of, timed_run
from q2r2_control.config.cell import load_config
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

pytestmark = pytest.mark.slow

CONFIG = load_config("config/dual_iiwa7.yaml")
DT = 0.001


class ConstantSpeed:
    """Turns one joint at a constant speed, and fails as told in some ticks."""

    name, limitations = "constant speed", "everything"

    def __init__(self, joint: int, speed: float, fault: str = "", failing: tuple[int, ...] = ()) -> None:
        self._joint, self._speed, self._fault, self._failing = joint, speed, fault, failing

    def reset(self, q: Array) -> None:
        self._q, self._tick = q.copy(), -1

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        self._tick += 1
        v = np.zeros(len(self._q))
        v[self._joint] = self._speed
        if self._tick in self._failing:
            if self._fault == "raises":
                raise RuntimeError("no solution")
            return self._q, np.full(len(v), np.nan)
        self._q = self._q + v * dt
        return self._q.copy(), v

    def hold(self) -> tuple[Array, Array]:
        return self._q.copy(), np.zeros(len(self._q))


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(CONFIG)


def stay(t: float, start: Poses) -> Poses:
    return start


def test_metrics_are_computed_from_the_motion_alone(robot: Robot) -> None:
    run = timed_run(ConstantSpeed(joint=0, speed=-0.5), robot, stay, 100, DT)
    metrics = metrics_of(run, robot, CONFIG.control)
    q = robot.home.copy()
    q[0] -= 110 * 0.5 * DT
    assert len(run.times_us) == 100
    assert metrics.failures == 0
    assert metrics.max_acceleration_ratio == pytest.approx(0.5 / DT / robot.acceleration_limit[0])
    assert metrics.max_velocity_ratio == pytest.approx(0.5 / robot.velocity_limit[0])
    way = np.linalg.norm(robot.tool_pose(q, "left").translation - robot.tool_pose(robot.home, "left").translation)
    assert metrics.position_error_mm == pytest.approx(1e3 * way)
    distances = [min(pair.distance for pair in robot.distances(posture)) for posture in run.q]
    assert metrics.min_distance_mm == pytest.approx(1e3 * min(distances))
    room = np.minimum(run.q - robot.position_lower, robot.position_upper - run.q) - CONFIG.control.position_margin
    assert metrics.min_position_margin_rad == pytest.approx(room.min())


@pytest.mark.parametrize("fault", ["raises", "not finite"])
def test_a_failure_is_counted_and_the_arms_stand_still_in_that_tick(robot: Robot, fault: str) -> None:
    run = timed_run(ConstantSpeed(0, 0.5, fault, failing=(3, 60)), robot, stay, 100, DT)
    assert run.failures == 2
    np.testing.assert_array_equal(run.q[3], run.q[2])
    assert not run.v[3].any()
    assert run.v[4, 0] == 0.5


def test_peers_run_in_turns_with_ours_in_every_scenario() -> None:
    names = [name for name in PEERS if is_installed(name) and not name.startswith("roboplan")]
    if not names:
        pytest.skip(f"no peer is installed; {INSTALL}")
    rounds: list[str] = []
    report = run_bench(CONFIG, 100, names, rounds.append)
    ours, *others = [row for row in report.rows if row.name == "contact"]
    assert [row.controller for row in others] == names
    assert ours.rounds == sum(row.rounds for row in others)
    assert all(row.median_ratio is not None and row.median_ratio > 0.0 for row in others)
    assert rounds[: len(names)] == [f"free motion, {name}, round 1 of 3" for name in names]
    assert [note.split(":")[0] for note in report.notes] == names


def test_peers_that_are_missing_or_broken_cost_a_line_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PEERS, "missing", "no_such_package_anywhere")
    monkeypatch.setitem(PEERS, "broken", "json")
    report = run_bench(CONFIG, 100, ("missing", "broken"))
    assert [row.controller for row in report.rows] == ["q2r2_control"] * len(SCENARIOS)
    assert report.notes[0] == f"missing: not installed; {INSTALL}"
    assert report.notes[1].startswith("broken: cannot be built for this cell: ModuleNotFoundError")
