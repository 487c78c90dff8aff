"""No tool is faster than its limit. The tests check the bound B of tool_speed.py, and runs of the controller."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, Solver
from q2r2_control.config.cell_file import load_config
from q2r2_control.control.safety.stop_rollout import SHAPES
from q2r2_control.control.safety.tool_speed import drift, fastest_tool
from q2r2_control.types import Array, LimitKind
from q2r2_control.verification.contract import Contract
from q2r2_control.verification.fault_injection import PushingSolver
from q2r2_control.verification.tool_speeds import MeasuredToolSpeeds
from tests.control.cells import NAMES, cell, kernel_model, random_posture, reused_data
from tests.control.safety.motions import ACCELERATION, H, Motion, motion_of

LIMIT, DT = 0.25, 0.002


def speeds_along(name: str, motion: Motion) -> tuple[float, float]:
    """Return the speed of the fastest tool at the start of the motion, and in the whole step and stop [m/s]."""
    robot = cell(name).robot
    tools, t = MeasuredToolSpeeds(robot), np.linspace(0.0, 1.0, 30)[:, None]
    in_step = motion.v + t * (motion.v_next - motion.v)
    q = motion.q + t * H * motion.v + 0.5 * t**2 * H * (motion.v_next - motion.v)
    time = 1.0001 * t * np.max(np.abs(motion.v_next) / motion.deceleration)
    moving = np.minimum(time, np.abs(motion.v_next) / motion.deceleration)
    brake = np.sign(motion.v_next) * motion.deceleration
    q_stop, v_stop = motion.q_next + motion.v_next * moving - 0.5 * brake * moving**2, motion.v_next - brake * moving
    return tools.fastest(motion.q, motion.v), max(tools.fastest(q, in_step), tools.fastest(q_stop, v_stop))


def bound_of(name: str, motion: Motion) -> float:
    model, data = kernel_model(name).safety, reused_data(name, motion.q, motion.v).safety
    data.candidate.q[:], data.candidate.v[:] = motion.q_next, motion.v_next
    data.candidate.deceleration[:] = motion.deceleration
    return max(fastest_tool(model, data, i, H) for i in range(len(model.tools.joint)))


@pytest.mark.parametrize("shape", range(SHAPES), ids=["together", "arm by arm", "own"])
@pytest.mark.parametrize("name", NAMES)
def test_no_tool_is_faster_than_the_bound_in_a_step_and_in_any_kind_of_stop(name: str, shape: int) -> None:
    random, robot, shares = np.random.default_rng(71), cell(name).robot, []
    for number in range(40):
        q = random_posture(robot, random)
        v = random.choice([0.02, 0.3, 1.0]) * random.uniform(-robot.velocity_limit, robot.velocity_limit)
        v_next = v + random.uniform(-1, 1, robot.model.nv) * ACCELERATION * H
        if number % 4 == 0:  # The tools are at rest while the joints move, and become faster during the stop.
            v = v_next = _without_motion_of_tools(robot, q, v)
        motion = motion_of(name, q, v, v_next, shape)
        before, fastest = speeds_along(name, motion)
        bound = bound_of(name, motion)
        assert fastest <= max(before, bound) * (1.0 + 1e-12)
        shares.append(fastest / bound)
    assert max(shares) > 0.9, "a bound that nothing comes near would make arms slow"


def _without_motion_of_tools(robot: Robot, q: Array, v: Array) -> Array:
    """Return the joint velocities nearest to ``v`` (nv,) with which the origins of all tools are at rest."""
    data = robot.model.createData()
    pin.computeJointJacobians(robot.model, data, q)
    rows = [
        pin.getFrameJacobian(robot.model, data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)[:3]
        for arm in robot.arms.values()
    ]
    jacobian = np.concatenate(rows)
    return np.asarray(v - np.linalg.pinv(jacobian) @ (jacobian @ v))


@pytest.mark.parametrize("name", NAMES)
def test_the_drift_bounds_the_acceleration_of_a_tool_whose_joints_keep_their_speeds(name: str) -> None:
    random, robot, shares = np.random.default_rng(73), cell(name).robot, []
    data = robot.model.createData()
    for _ in range(100):
        # In many samples, few joints move before the step, and few joints move after it.
        moves = random.random((2, robot.model.nv)) < random.choice([0.05, 0.2, 0.8], (2, 1))
        v, v_next = random.uniform(-1.0, 1.0, (2, robot.model.nv)) * moves
        between = v + random.choice([0.0, 0.5, 1.0]) * (v_next - v)
        pin.forwardKinematics(robot.model, data, random_posture(robot, random), between, np.zeros_like(v))
        for i, arm in enumerate(robot.arms.values()):
            tool = pin.getFrameClassicalAcceleration(robot.model, data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)
            bound = drift(kernel_model(name).safety, i, v, v_next)
            assert np.linalg.norm(tool.linear) <= bound * (1.0 + 1e-9) + 1e-12
            shares.append(np.linalg.norm(tool.linear) / max(bound, 1e-12))
    assert max(shares) > 0.3, "a bound that nothing comes near would make arms slow"


def limited(robot: Robot, solver: Solver | None = None) -> CartesianController:
    settings = load_config("config/dual_iiwa7.yaml").control.timed(realtime=False)
    return CartesianController(robot, settings.model_copy(update={"tool_speed_limit": LIMIT}), solver=solver)


def test_with_a_solver_that_drives_joints_at_full_speed_no_tool_is_too_fast_at_or_between_ticks(robot: Robot) -> None:
    controller = limited(robot, solver=PushingSolver(80))
    contract, fastest = Contract(controller, sample_all=True), 0.0
    for _ in range(240):
        reference = controller.step({}, DT)
        contract.check(reference, DT)
        fastest = max(fastest, MeasuredToolSpeeds(robot).fastest(reference.q, reference.v))
    assert 0.8 * LIMIT < fastest <= LIMIT
    assert contract.margins["tool_speed"].checked > 200


def test_a_tool_moves_to_a_far_target_at_nearly_its_speed_limit_and_no_report_names_this_limit(robot: Robot) -> None:
    controller = limited(robot)
    contract, goal = Contract(controller), controller.tool_pose("left")
    goal.translation += [0.1, 0.2, 0.1]
    fastest, held = 0.0, 0
    for _ in range(1500):
        reference = controller.step({"left": goal}, DT)
        contract.check(reference, DT)
        fastest = max(fastest, MeasuredToolSpeeds(robot).fastest(reference.q, reference.v))
        held += any(limit.kind is LimitKind.TOOL_SPEED for limit in reference.report.binding)
    assert 0.85 * LIMIT < fastest <= LIMIT
    assert held == 0
    assert np.linalg.norm(controller.tool_pose("left").translation - goal.translation) < 1e-3


def fast_start(robot: Robot) -> Array:
    """Return joint velocities (nv,) with which the left tool moves at three times its limit [rad/s]."""
    data = robot.model.createData()
    pin.computeJointJacobians(robot.model, data, robot.home)
    J = pin.getFrameJacobian(robot.model, data, robot.arms["left"].frame_id, pin.LOCAL_WORLD_ALIGNED)[:3]
    return np.asarray(np.linalg.pinv(J) @ [0.0, 0.0, 3.0 * LIMIT])


def test_a_tool_that_starts_too_fast_is_braked_and_the_report_names_its_speed_limit(robot: Robot) -> None:
    controller, v = limited(robot, solver=PushingSolver(80)), fast_start(robot)
    controller.reset(robot.home, v)
    tools, before, certified = MeasuredToolSpeeds(robot), 3.0 * LIMIT, []
    for _ in range(220):
        reference = controller.step({}, DT)
        speed = tools.fastest(reference.q, reference.v)
        assert speed <= max(LIMIT, before)
        if speed > LIMIT:
            assert any(one.kind is LimitKind.TOOL_SPEED and one.names == ("left",) for one in reference.report.binding)
        before = speed
        certified.append(reference.report.certified)
    assert not certified[0]
    assert all(certified[-50:])
    assert before <= LIMIT
