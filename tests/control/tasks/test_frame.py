from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control import CartesianController
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.targets import TaskTargets
from q2r2_control.control.tasks.frame import (
    ROTATION_LENGTH,
    Motion,
    accumulate_tool_cost,
    approach_speed,
    rotation_vector,
    tool_jacobian,
    tool_pose,
    tools_of,
    wanted_twist,
)
from q2r2_control.types import Array
from tests.control.cells import NAMES, cell, kernel_model, placed, random_posture, reused_data
from tests.support.driven import Driven

MOTION = Motion(np.array([6.0, 5.0]), np.array([2.0, 5.0]), np.array([1.0, 2.5]), np.array([0.02]), np.ones(6))


@pytest.mark.parametrize("name", NAMES)
def test_tool_poses_and_jacobians_equal_the_results_of_pinocchio(name: str) -> None:
    arrays, random = cell(name), np.random.default_rng(20)
    model, data, tools = arrays.robot.model, arrays.robot.model.createData(), tools_of(arrays.robot)
    rotation, translation, J = np.zeros((3, 3)), np.zeros(3), np.ones((6, model.nv))
    for _ in range(20):
        q = random_posture(arrays.robot, random)
        placements = placed(arrays, q).placements
        pin.computeJointJacobians(model, data, q)
        for i, arm in enumerate(arrays.robot.arms.values()):
            pose = pin.updateFramePlacement(model, data, arm.frame_id)
            tool_pose(placements, tools, i, rotation, translation)
            np.testing.assert_allclose(rotation, pose.rotation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(translation, pose.translation, rtol=0, atol=1e-12)
            tool_jacobian(arrays.collision.chain, placements, tools, i, translation, J)
            expected = pin.getFrameJacobian(model, data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)
            np.testing.assert_allclose(J, expected, rtol=0, atol=1e-12)


def _vector(R: Array) -> Array:
    out = np.zeros(3)
    rotation_vector(R, out)
    return out


ANGLES = [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3, 0.5, 1.5, 2.0, 2.1, 3.0, np.pi - 1e-3, np.pi - 1e-6]


@pytest.mark.parametrize("angle", ANGLES, ids="{:.7g} rad".format)
def test_a_rotation_vector_equals_the_logarithm_that_pinocchio_computes(angle: float) -> None:
    random = np.random.default_rng(21)
    axes = [*np.eye(3), *-np.eye(3), *random.normal(size=(50, 3))]
    for axis in axes:
        wanted = angle * axis / np.linalg.norm(axis)
        R = pin.exp3(wanted)
        np.testing.assert_allclose(_vector(R), wanted, rtol=0, atol=1e-9)
        np.testing.assert_allclose(_vector(R), pin.log3(R), rtol=0, atol=1e-7)


@pytest.mark.parametrize("below", [0.0, 1e-15, 1e-12, 1e-8], ids="pi less {} rad".format)
def test_the_rotation_vector_of_half_a_turn_has_one_of_the_two_directions_of_its_axis(below: float) -> None:
    random = np.random.default_rng(22)
    for axis in [*np.eye(3), *-np.eye(3), *random.normal(size=(50, 3))]:
        R = pin.exp3((np.pi - below) * axis / np.linalg.norm(axis))
        vector = _vector(R)
        assert np.linalg.norm(vector) == pytest.approx(np.pi, abs=2e-8)
        np.testing.assert_allclose(pin.exp3(vector), R, rtol=0, atol=1e-8)


@given(gain=st.floats(0.1, 50.0), deceleration=st.floats(0.1, 50.0), share=st.floats(0.0, 5.0))
@settings(derandomize=True, max_examples=300, deadline=None)
def test_the_approach_speed_and_its_slope_are_continuous(gain: float, deceleration: float, share: float) -> None:
    bend = deceleration / gain**2
    step = 1e-6 * bend
    for error in (bend, share * bend + 2 * step):
        before, here, after = (approach_speed(error + k * step, gain, deceleration) for k in (-1, 0, 1))
        assert before < here < after
        assert (after - here) / step == pytest.approx((here - before) / step, rel=1e-3)


@cache
def _targets() -> TaskTargets:
    return TaskTargets.empty(kernel_model("dual_iiwa7").tasks, ControllerSettings())


def _twist(tool: pin.SE3, target: pin.SE3, feed_forward: Array) -> Array:
    arm, data, targets = 1, reused_data("dual_iiwa7", np.zeros(14)).tasks, _targets()
    data.rotation[arm], data.translation[arm] = tool.rotation, tool.translation
    targets.rotation[arm], targets.translation[arm] = target.rotation, target.translation
    targets.feed_forward[arm] = feed_forward
    wanted_twist(MOTION, data, targets, arm)
    return data.frame.twist[arm]


def _poses(random: np.random.Generator) -> tuple[pin.SE3, pin.SE3]:
    tool, target = (pin.SE3(pin.exp3(random.normal(size=3)), random.uniform(-1, 1, 3)) for _ in range(2))
    return tool, target


def test_the_wanted_twist_never_exceeds_the_speed_limits() -> None:
    random = np.random.default_rng(24)
    for _ in range(200):
        tool, target = _poses(random)
        twist = _twist(tool, target, 10.0 ** random.uniform(-2, 1) * random.normal(size=6))
        assert np.linalg.norm(twist[:3]) <= MOTION.full_speed[0] + 1e-12
        assert np.linalg.norm(twist[3:]) <= MOTION.full_speed[1] + 1e-12


def test_the_cost_of_a_tool_is_the_weighted_square_of_its_twist_error() -> None:
    random = np.random.default_rng(26)
    J, twist, weight = random.normal(size=(6, 14)), random.normal(size=6), random.uniform(size=6)
    J[:, 7:] = 0.0
    H, g = np.zeros((14, 14)), np.zeros(14)
    accumulate_tool_cost(J, twist, weight, 0.1, H, g)
    W = np.diag(weight * np.array([1.0] * 3 + [ROTATION_LENGTH**2] * 3))
    np.testing.assert_allclose(H, 0.1 * J.T @ W @ J, atol=1e-12)
    np.testing.assert_allclose(g, -0.1 * J.T @ W @ twist, atol=1e-12)


# Columns 1 and 2: the weights of the position and of the rotation.
# Column 3: True for each of x, y and z at which the tool reaches the position of the target.
# Column 4: True if the tool's z axis reaches the direction of the target's z axis.
PARTS = {
    "position only": ((1, 1, 1), (0, 0, 0), (True, True, True), False),
    "rotation only": ((0, 0, 0), (1, 1, 1), (False, False, False), True),
    "height and rotation": ((0, 0, 1), (1, 1, 1), (False, False, True), True),
    "free about the tool's z": ((1, 1, 1), (1, 1, 0), (True, True, True), True),
}


@pytest.mark.parametrize("name", PARTS)
def test_a_tool_moves_to_the_weighted_parts_of_a_target_and_the_posture_decides_the_other_parts(name: str) -> None:
    along, about, reached, upright = PARTS[name]
    settings = ControllerSettings(position_weights=along, rotation_weights=about)
    controller = CartesianController(cell("dual_iiwa7").robot, settings)
    driven = Driven(controller, dt=0.004)
    by = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 0.0) @ pin.rpy.rpyToMatrix(0.0, 0.0, 0.6), np.array([0.05, 0.06, 0.08]))
    goals = {
        arm: pin.SE3(pose.rotation @ by.rotation, pose.translation + by.translation)
        for arm, pose in driven.start.items()
    }
    driven.drive(5.0, goals)
    assert driven.contract.tail_acceleration() < 0.1
    for arm, goal in goals.items():
        tool = controller.tool_pose(arm)
        found = np.abs(tool.translation - goal.translation) < 1e-3
        assert found.tolist() == list(reached)
        tilt = np.linalg.norm(np.cross(tool.rotation[:, 2], goal.rotation[:, 2]))
        turn = np.linalg.norm(pin.log3(tool.rotation.T @ goal.rotation))
        assert (tilt < 1e-3) == upright
        assert (turn < 1e-3) == (about == (1, 1, 1))


def test_if_all_weights_of_the_tools_are_zero_the_joints_move_to_the_given_posture() -> None:
    robot = cell("dual_iiwa7").robot
    controller = CartesianController(robot, ControllerSettings(position_weights=(0, 0, 0), rotation_weights=(0, 0, 0)))
    driven = Driven(controller)
    wanted = robot.home + 0.1
    for _ in range(1500):
        reference = controller.step(driven.start, 0.004, wanted)
        driven.contract.check(reference, 0.004)
    np.testing.assert_allclose(reference.q, wanted, atol=1e-3)
