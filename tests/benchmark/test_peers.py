"""Peers, which are other controllers, follow targets on the same cell. A peer that is not installed is skipped."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.benchmark.motion_run import run_motion
from q2r2_control.benchmark.peers.base import (
    INSTALL,
    PEERS,
    WITHOUT_ACCELERATION_LIMIT,
    BenchController,
    Leading,
    PeerSettings,
    is_installed,
    make_peer,
)
from q2r2_control.benchmark.work_motions import WORK_MOTIONS
from q2r2_control.config.cell_file import load_config
from q2r2_control.robot.robot import Robot

DT = 0.001
CONFIG = load_config("config/dual_iiwa7.yaml")
ROBOT = Robot.from_config(CONFIG)
HOME = {arm: ROBOT.tool_pose(ROBOT.home, arm) for arm in ROBOT.arms}


@pytest.fixture(scope="module", params=PEERS)
def peer(request: pytest.FixtureRequest) -> BenchController:
    if not is_installed(request.param):
        pytest.skip(f"{PEERS[request.param]} is not installed; {INSTALL}")
    return make_peer(request.param, PeerSettings(ROBOT, CONFIG, DT))


@pytest.mark.slow
def test_a_peer_rests_at_home_if_its_targets_are_there_and_moves_to_other_targets_within_the_limits(
    peer: BenchController,
) -> None:
    peer.reset(ROBOT.home)
    for _ in range(20):
        q, v = peer.step(HOME, DT)
        np.testing.assert_allclose(q, ROBOT.home, atol=1e-4)
        np.testing.assert_allclose(v, 0.0, atol=1e-2)
    turn, way = pin.exp3(np.array([0.1, -0.1, 0.2])), np.array([0.02, 0.0, 0.05])
    goals = {arm: pin.SE3(turn @ pose.rotation, pose.translation + way) for arm, pose in HOME.items()}
    for _ in range(1200):
        before = q
        q, v = peer.step(goals, DT)
        assert (np.abs(v) <= ROBOT.velocity_limit * (1.0 + 1e-3)).all()
        np.testing.assert_allclose(q - before, v * DT, atol=1e-12)
    for arm, pose in goals.items():
        error = ROBOT.tool_pose(q, arm).actInv(pose)
        # The remaining error comes from the posture task, whose weight is a thousandth of the tool task's.
        assert np.linalg.norm(error.translation) < 0.001
        assert np.linalg.norm(pin.log3(error.rotation)) < 0.002


def test_a_peer_with_an_acceleration_limit_starts_as_slowly_as_our_controller(peer: BenchController) -> None:
    if peer.name in WITHOUT_ACCELERATION_LIMIT:
        pytest.skip("it has none")
    peer.reset(ROBOT.home)
    goals = {arm: pin.SE3(pose.rotation, pose.translation + 0.1) for arm, pose in HOME.items()}
    _, v = peer.step(goals, DT)
    # In this tick, the limit allows a motion of 1e-5 rad. The solution of roboplan may have an error of 1e-6 rad. The
    # test therefore permits a quarter more than the limit.
    limit = ROBOT.capped_acceleration(CONFIG.control.acceleration_limit)
    assert (np.abs(v) <= 1.25 * limit * DT).all()


@pytest.mark.slow
def test_in_free_motion_a_peer_follows_its_target_as_closely_as_its_gain_allows(peer: BenchController) -> None:
    figures = run_motion(Leading(peer, CONFIG.control.position_gain), ROBOT, WORK_MOTIONS["reach-under"])
    # Without Leading, the tool would be 35 mm behind its target, which moves at 0.28 m/s.
    assert figures.max_error_mm is not None
    assert figures.max_error_mm < 5.0
    assert figures.arrival_s is not None
    assert (figures.failures, figures.fallback_percent) == (0, None)
