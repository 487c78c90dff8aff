"""Peers follow targets on the same cell; each is skipped where its package is not installed."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.benchmark.peers.base import (
    INSTALL,
    PEERS,
    WITHOUT_ACCELERATION_LIMIT,
    BenchController,
    PeerSettings,
    is_installed,
    make_peer,
)
from q2r2_control.config.cell import load_config
from q2r2_control.robot.robot import Robot

DT = 0.001
CONFIG = load_config("config/dual_iiwa7.yaml")


@cache
def robot() -> Robot:
    return Robot.from_config(CONFIG)


@cache
def peer_of(name: str) -> BenchController:
    return make_peer(name, PeerSettings(robot(), CONFIG, DT))


@pytest.fixture(params=PEERS)
def peer(request: pytest.FixtureRequest) -> BenchController:
    """Each peer at rest at home."""
    if not is_installed(request.param):
        pytest.skip(f"{PEERS[request.param]} is not installed; {INSTALL}")
    found = peer_of(request.param)
    found.reset(robot().home)
    return found


def home() -> dict[str, pin.SE3]:
    return {arm: robot().tool_pose(robot().home, arm) for arm in robot().arms}


def test_a_peer_at_its_targets_stays_there(peer: BenchController) -> None:
    for _ in range(20):
        q, v = peer.step(home(), DT)
        np.testing.assert_allclose(q, robot().home, atol=1e-4)
        np.testing.assert_allclose(v, 0.0, atol=1e-2)


def test_a_peer_reaches_a_target_within_the_velocity_limits(peer: BenchController) -> None:
    turn = pin.exp3(np.array([0.1, -0.1, 0.2]))
    goals = {
        arm: pin.SE3(turn @ pose.rotation, pose.translation + np.array([0.02, 0.0, 0.05]))
        for arm, pose in home().items()
    }
    for _ in range(1200):
        q, v = peer.step(goals, DT)
        assert (np.abs(v) <= robot().velocity_limit * (1.0 + 1e-3)).all()
    for arm, pose in goals.items():
        error = robot().tool_pose(q, arm).actInv(pose)
        # What is left is the posture's pull, which weighs a thousandth of the tool's.
        assert np.linalg.norm(error.translation) < 0.001
        assert np.linalg.norm(pin.log3(error.rotation)) < 0.002


def test_velocities_are_those_of_the_positions(peer: BenchController) -> None:
    goals = {arm: pin.SE3(pose.rotation, pose.translation + 0.1) for arm, pose in home().items()}
    before = robot().home
    for _ in range(10):
        q, v = peer.step(goals, DT)
        np.testing.assert_allclose(q - before, v * DT, atol=1e-12)
        before = q


@pytest.mark.parametrize("name", [name for name in PEERS if name not in WITHOUT_ACCELERATION_LIMIT])
def test_a_peer_with_an_acceleration_limit_starts_as_slowly_as_we_do(name: str) -> None:
    pytest.importorskip(PEERS[name])
    peer = peer_of(name)
    peer.reset(robot().home)
    goals = {arm: pin.SE3(pose.rotation, pose.translation + 0.1) for arm, pose in home().items()}
    _, v = peer.step(goals, DT)
    # roboplan's solver tolerance, 1e-6 rad in a tick, is a tenth of what the limit allows.
    limit = robot().capped_acceleration(CONFIG.control.acceleration_limit)
    assert (np.abs(v) <= 1.25 * limit * DT).all()
