"""The bench runs ours in free air, ours, and the peers that there are, all through the same motions."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.benchmark.bench import run_bench
from q2r2_control.benchmark.motion_run import run_motion
from q2r2_control.benchmark.peers.base import INSTALL, PEERS, Leading, PeerSettings, is_installed, make_peer
from q2r2_control.benchmark.work_motions import TIMED_MOTIONS, WORK_MOTIONS, motions_named
from q2r2_control.config.cell import load_config
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

pytestmark = pytest.mark.slow

CONFIG = load_config("config/dual_iiwa7.yaml")


class Listening:
    """Keeps the targets that it is given."""

    name, limitations = "listening", ""

    def reset(self, q: Array) -> None:
        self.given: list[pin.SE3] = []

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        self.given.append(targets["left"])
        return np.zeros(1), np.zeros(1)

    def hold(self) -> tuple[Array, Array]:
        return np.ones(1), np.zeros(1)


def test_a_row_has_ours_in_free_air_and_near_the_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
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
    assert ours.min_distance_mm >= 1.0  # fingers and obstacles
    assert row.free_air.rms_error_mm is not None
    assert ours.rms_error_mm is not None
    # It is asked for 10 mm that the table does not allow.
    assert row.free_air.rms_error_mm < 2.0 < 9.0 < ours.rms_error_mm
    assert ours.times_us is not None
    assert list(ours.times_us) == sorted(ours.times_us)
    assert report.as_json()["rows"][0]["figures"][0]["motion"] == "slide"


def test_ticks_are_timed_in_free_motion_and_in_contact() -> None:
    free, contact = run_bench(CONFIG, TIMED_MOTIONS, ()).rows
    assert free.figures[0].rms_error_mm == pytest.approx(free.free_air.rms_error_mm, rel=1e-3)
    assert contact.figures[0].min_distance_mm is not None
    assert free.figures[0].min_distance_mm is not None
    assert 1.0 <= contact.figures[0].min_distance_mm < 4.0 < 25.0 < free.figures[0].min_distance_mm


def test_a_peer_is_given_its_target_ahead_by_speed_over_gain() -> None:
    peer = Listening()
    leading = Leading(peer, gain=8.0)
    leading.reset(np.zeros(1))
    turn = np.array([0.0, 0.0, 0.001])
    for tick in range(3):
        pose = pin.SE3(pin.exp3(tick * turn), np.array([0.0004 * tick, 0.0, 0.1]))
        leading.step({"left": pose}, 0.001)
    assert peer.given[0].isApprox(pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1])), 1e-15)
    # 0.4 m/s and 1 rad/s, an eighth of a second ahead.
    np.testing.assert_allclose(peer.given[2].translation, [0.0008 + 0.05, 0.0, 0.1], atol=1e-12)
    np.testing.assert_allclose(pin.log3(peer.given[2].rotation), [0.0, 0.0, 0.002 + 0.125], atol=1e-12)
    assert leading.hold()[0] == 1.0
    leading.reset(np.zeros(1))
    leading.step({"left": pose}, 0.001)
    assert peer.given[0].isApprox(pose, 1e-15)


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_follows_in_free_motion_as_well_as_its_gain_allows(name: str) -> None:
    if not is_installed(name):
        pytest.skip(f"{PEERS[name]} is not installed; {INSTALL}")
    robot = Robot.from_config(CONFIG)
    peer = Leading(make_peer(name, PeerSettings(robot, CONFIG, 0.001)), CONFIG.control.position_gain)
    figures = run_motion(peer, robot, WORK_MOTIONS["reach-under"])
    # Without the lead it would lag 35 mm at the target's 0.28 m/s.
    assert figures.max_error_mm is not None
    assert figures.max_error_mm < 5.0
    assert figures.arrival_s is not None
    assert (figures.failures, figures.fallback_percent) == (0, None)
