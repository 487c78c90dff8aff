from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.control.tasks.frame import (
    ROTATION_LENGTH,
    Motion,
    Tools,
    add_tool_task,
    approach_speed,
    project_to_nullspace,
    rotation_vector,
    tool_jacobian,
    tool_pose,
    wanted_twist,
)
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.control.cells import NAMES, cell, placed, random_posture

MOTION = Motion(np.array([6.0, 5.0]), np.array([2.0, 5.0]), np.array([1.0, 2.5]), 0.02)


def _tools(robot: Robot) -> Tools:
    frames = [robot.model.frames[arm.frame_id] for arm in robot.arms.values()]
    return Tools(
        np.array([frame.parentJoint for frame in frames]),
        np.array([frame.placement.rotation for frame in frames]),
        np.array([frame.placement.translation for frame in frames]),
        np.array([np.isin(np.arange(robot.model.nv), arm.joints).astype(float) for arm in robot.arms.values()]),
    )


@pytest.mark.parametrize("name", NAMES)
def test_tool_poses_and_jacobians_equal_pinocchios(name: str) -> None:
    arrays, random = cell(name), np.random.default_rng(20)
    model, data, tools = arrays.robot.model, arrays.robot.model.createData(), _tools(arrays.robot)
    rotation, translation, J = np.zeros((3, 3)), np.zeros(3), np.ones((6, model.nv))
    for _ in range(20):
        q = random_posture(arrays.robot, random)
        placements, _ = placed(arrays, q)
        pin.computeJointJacobians(model, data, q)
        for i, arm in enumerate(arrays.robot.arms.values()):
            pose = pin.updateFramePlacement(model, data, arm.frame_id)
            tool_pose(placements, tools, i, rotation, translation)
            np.testing.assert_allclose(rotation, pose.rotation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(translation, pose.translation, rtol=0, atol=1e-12)
            tool_jacobian(arrays.chain, placements, tools, i, translation, J)
            expected = pin.getFrameJacobian(model, data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)
            np.testing.assert_allclose(J, expected, rtol=0, atol=1e-12)


def _vector(R: Array) -> Array:
    out = np.zeros(3)
    rotation_vector(R, out)
    return out


ANGLES = [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3, 0.5, 1.5, 2.0, 2.1, 3.0, np.pi - 1e-3, np.pi - 1e-6]


@pytest.mark.parametrize("angle", ANGLES, ids="{:.7g} rad".format)
def test_a_rotation_vector_is_pinocchios_logarithm(angle: float) -> None:
    random = np.random.default_rng(21)
    axes = [*np.eye(3), *-np.eye(3), *random.normal(size=(50, 3))]
    for axis in axes:
        wanted = angle * axis / np.linalg.norm(axis)
        R = pin.exp3(wanted)
        np.testing.assert_allclose(_vector(R), wanted, rtol=0, atol=1e-9)
        np.testing.assert_allclose(_vector(R), pin.log3(R), rtol=0, atol=1e-7)


@pytest.mark.parametrize("below", [0.0, 1e-15, 1e-12, 1e-8], ids="pi less {} rad".format)
def test_half_a_turn_has_a_rotation_vector_about_one_side_of_its_axis(below: float) -> None:
    random = np.random.default_rng(22)
    for axis in [*np.eye(3), *-np.eye(3), *random.normal(size=(50, 3))]:
        R = pin.exp3((np.pi - below) * axis / np.linalg.norm(axis))
        vector = _vector(R)
        assert np.linalg.norm(vector) == pytest.approx(np.pi, abs=2e-8)
        np.testing.assert_allclose(pin.exp3(vector), R, rtol=0, atol=1e-8)


@given(gain=st.floats(0.1, 50.0), deceleration=st.floats(0.1, 50.0), share=st.floats(0.0, 5.0))
@settings(derandomize=True, max_examples=300, deadline=None)
def test_the_approach_speed_is_continuous_and_so_is_its_slope(gain: float, deceleration: float, share: float) -> None:
    bend = deceleration / gain**2
    step = 1e-6 * bend
    for error in (bend, share * bend + 2 * step):
        before, here, after = (approach_speed(error + k * step, gain, deceleration) for k in (-1, 0, 1))
        assert before < here < after
        assert (after - here) / step == pytest.approx((here - before) / step, rel=1e-3)


@pytest.mark.parametrize("error", [0.001, 0.05, 0.2, 2.0], ids="from {} m".format)
def test_following_the_approach_speed_asks_for_no_more_than_the_planned_deceleration(error: float) -> None:
    gain, deceleration, dt = 8.0, 2.0, 1e-4
    speeds = []
    while error > 1e-6:
        speeds.append(approach_speed(error, gain, deceleration))
        error -= speeds[-1] * dt
    braking = -np.diff(speeds) / dt
    assert braking.max() <= deceleration * 1.01
    assert braking.min() >= 0.0


def _twist(tool: pin.SE3, goal: pin.SE3, feed_forward: Array, speed_limit: float = 1.0) -> Array:
    twist = np.zeros(6)
    wanted_twist(
        tool.rotation,
        tool.translation,
        goal.rotation,
        goal.translation,
        feed_forward,
        MOTION,
        speed_limit,
        twist,
        np.zeros(6),
        np.zeros((3, 3)),
    )
    return twist


def _poses(random: np.random.Generator) -> tuple[pin.SE3, pin.SE3]:
    tool, goal = (pin.SE3(pin.exp3(random.normal(size=3)), random.uniform(-1, 1, 3)) for _ in range(2))
    return tool, goal


def test_a_tool_that_moves_with_the_wanted_twist_reaches_its_goal() -> None:
    random, dt = np.random.default_rng(23), 0.01
    for _ in range(4):
        tool, goal = _poses(random)
        for _ in range(600):
            twist = _twist(tool, goal, np.zeros(6))
            tool = pin.SE3(pin.exp3(twist[3:] * dt) @ tool.rotation, tool.translation + twist[:3] * dt)
        assert np.linalg.norm(tool.translation - goal.translation) < 1e-6
        assert np.linalg.norm(pin.log3(tool.rotation.T @ goal.rotation)) < 1e-6


def test_the_wanted_twist_never_exceeds_the_speed_limits() -> None:
    random = np.random.default_rng(24)
    for _ in range(200):
        tool, goal = _poses(random)
        limit = random.uniform(0.01, 2.0)
        twist = _twist(tool, goal, 10.0 ** random.uniform(-2, 1) * random.normal(size=6), limit)
        allowed = min(limit, 1.0)
        assert np.linalg.norm(twist[:3]) <= allowed * MOTION.full_speed[0] + 1e-12
        assert np.linalg.norm(twist[3:]) <= allowed * MOTION.full_speed[1] + 1e-12


def test_at_the_goal_only_the_goals_own_motion_is_wanted() -> None:
    tool, _ = _poses(np.random.default_rng(25))
    moving = np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])
    np.testing.assert_allclose(_twist(tool, tool, moving), moving, atol=1e-12)


def test_a_tool_task_is_the_weighted_square_of_its_twist_error() -> None:
    random = np.random.default_rng(26)
    J, twist = random.normal(size=(6, 14)), random.normal(size=6)
    J[:, 7:] = 0.0
    H, g = np.zeros((14, 14)), np.zeros(14)
    add_tool_task(J, twist, 0.1, H, g)
    W = np.diag([1.0] * 3 + [ROTATION_LENGTH**2] * 3)
    np.testing.assert_allclose(H, 0.1 * J.T @ W @ J, atol=1e-12)
    np.testing.assert_allclose(g, -0.1 * J.T @ W @ twist, atol=1e-12)


def test_what_is_left_in_the_nullspace_moves_no_tool() -> None:
    random = np.random.default_rng(27)
    for _ in range(20):
        J = np.zeros((12, 14))
        J[:6, :7], J[6:, 7:] = random.normal(size=(6, 7)), random.normal(size=(6, 7))
        v = random.normal(size=14)
        exact = v - np.linalg.pinv(J) @ J @ v
        project_to_nullspace(J, v)
        np.testing.assert_allclose(J @ v, 0.0, atol=1e-4)
        np.testing.assert_allclose(v, exact, atol=1e-4)


def test_a_tool_without_a_jacobian_leaves_the_posture_as_it_is() -> None:
    v = np.arange(14.0)
    project_to_nullspace(np.zeros((12, 14)), v)
    np.testing.assert_array_equal(v, np.arange(14.0))


@pytest.mark.parametrize("name", NAMES)
def test_in_a_stretched_posture_the_nullspace_stays_finite(name: str) -> None:
    arrays = cell(name)
    tools = _tools(arrays.robot)
    placements, _ = placed(arrays, np.zeros(14))
    J, rotation, translation = np.zeros((12, 14)), np.zeros((3, 3)), np.zeros(3)
    for i in range(2):
        tool_pose(placements, tools, i, rotation, translation)
        tool_jacobian(arrays.chain, placements, tools, i, translation, J[6 * i : 6 * i + 6])
    v = np.full(14, 0.5)
    project_to_nullspace(J, v)
    assert np.linalg.norm(v) <= np.linalg.norm(np.full(14, 0.5)) + 1e-9
    np.testing.assert_allclose(J @ v, 0.0, atol=1e-3)
