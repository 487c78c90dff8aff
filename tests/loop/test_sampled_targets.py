"""Targets that come less often than the steps of a controller are interpolated."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot, RobotError, SampledTargets
from q2r2_control.types import Array
from tests.support.processes import cell

DT = 0.001  # [s]
LIMIT = 10.0  # Acceleration limit of a joint [rad/s^2].


@pytest.fixture(scope="module")
def controller() -> CartesianController:
    return CartesianController(Robot.from_config(cell()), ControllerSettings(acceleration_limit=LIMIT))


def wave(start: pin.SE3, t: float) -> pin.SE3:
    """Return the pose at ``t`` [s] of a sinusoidal motion, at up to 0.2 m/s and 0.6 rad/s."""
    turn = pin.exp3(np.array([0.0, 0.0, 0.3 * math.sin(2.0 * t)]))
    return pin.SE3(start.rotation @ turn, start.translation + np.array([0.0, 0.1 * math.sin(2.0 * t), 0.0]))


def share_at_limit(velocities: list[Array]) -> float:
    """Return the fraction of steps, after the first 300, in which some joint is at its acceleration limit."""
    accelerations = np.abs(np.diff(np.array(velocities[300:]), axis=0)).max(axis=1) / DT
    return float((accelerations > 0.99 * LIMIT).mean())


@pytest.mark.parametrize("rate", [10.0, 30.0, 90.0])
@pytest.mark.parametrize("jitter", [0.0, 0.2], ids=["even", "uneven by a fifth of a period"])
def test_joints_are_hardly_ever_at_their_acceleration_limits_while_a_tool_follows_sampled_targets(
    controller: CartesianController, rate: float, jitter: float
) -> None:
    controller.reset(controller.robot.home)
    targets, start = SampledTargets(controller, rate), controller.tool_pose("left")
    late = jitter * np.random.default_rng(0).uniform(size=1000) / rate
    sent, velocities, off = 0, list[Array](), list[float]()
    for step in range(1500):
        now = step * DT
        while sent / rate + late[sent] <= now:
            assert targets.set("left", wave(start, sent / rate), now)
            sent += 1
        velocities.append(controller.step(targets.at(now), DT).v)
        behind = max(now - targets.delay - jitter / rate, 0.0)
        error = wave(start, behind).actInv(controller.tool_pose("left"))
        off.append(float(np.linalg.norm(error.translation)))
    assert share_at_limit(velocities) <= 0.05
    assert max(off[300:]) < 0.01


def test_interpolation_starts_at_the_tool_and_ends_at_the_newest_sample_and_a_release_ends_the_target(
    controller: CartesianController,
) -> None:
    controller.reset(controller.robot.home)
    targets, start = SampledTargets(controller, 50.0), controller.tool_pose("right")
    goal = start * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.02]))
    assert targets.at(0.0) == {}
    targets.set("right", goal, 0.0)
    np.testing.assert_allclose(targets.at(0.0)["right"].homogeneous, start.homogeneous, atol=1e-9)
    halfway = targets.at(targets.delay / 2.0)["right"].translation
    np.testing.assert_allclose(halfway, (start.translation + goal.translation) / 2.0, atol=1e-6)
    for t in (targets.delay + 1e-6, 5.0):
        np.testing.assert_allclose(targets.at(t)["right"].homogeneous, goal.homogeneous, atol=1e-6)
    targets.release("right")
    assert targets.at(6.0) == {}


def test_a_sample_that_is_not_a_valid_pose_is_not_used_and_other_invalid_arguments_raise_errors(
    controller: CartesianController,
) -> None:
    targets, start = SampledTargets(controller, 50.0), controller.tool_pose("left")
    assert not targets.set("left", pin.SE3(np.eye(3), np.array([math.nan, 0.0, 0.0])), 0.0)
    assert not targets.set("left", pin.SE3(2.0 * np.eye(3), np.zeros(3)), 0.0)
    assert not targets.set("left", pin.SE3(np.full((3, 3), math.nan), np.zeros(3)), 0.0)
    assert targets.at(0.0) == {}
    for action, message in (
        (lambda: targets.set("middle", start, 0.0), "middle"),
        (lambda: targets.set("left", start.homogeneous, 0.0), "pose"),
        (lambda: targets.set("left", start, math.nan), "now = nan"),
        (lambda: targets.at(math.inf), "now = inf"),
        (lambda: SampledTargets(controller, 0.5), r"rate_hz = 0\.5"),
    ):
        with pytest.raises(RobotError, match=message):
            action()
