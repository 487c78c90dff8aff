"""Velocity commands let the arms follow the reference within limits. No command uses a state that is not trusted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.drives.base import FEEDBACK_GAIN, TorqueDrive, VelocityDrive
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.types import CommandMode, Reference, RobotState, StepReport, StepStatus
from tests.pipeline.loops import pipeline
from tests.support.processes import Watch, cell


@pytest.mark.slow
def test_in_velocity_mode_both_arms_follow_their_reference_within_every_limit() -> None:
    loop = pipeline(plant="mujoco", mode="velocity")
    watch = Watch(loop)
    summary = loop.run(2.5, realtime=False)
    assert summary.at_rest
    for tick, after in zip(watch.ticks, watch.ticks[1:], strict=False):
        assert np.abs(after.state.q - tick.reference.q).max() < 0.02
    assert max(np.abs(tick.reference.v).max() for tick in watch.ticks) > 0.1
    error = summary.arms["left"].position_error_mm_rms
    assert error is not None
    assert error < 3.0
    rest = loop.plant.state().q
    loop.plant.advance(0.5)
    np.testing.assert_allclose(loop.plant.state().q, rest, atol=1e-3)


def at(q: np.ndarray, v: np.ndarray) -> Reference:
    return Reference(q, v, 0.0 * q, StepReport(StepStatus.OK, (), (), ("", ""), 1.0, True, False, 0.0, 0.0))


def test_the_velocity_command_is_bounded_and_has_no_feedback_if_the_state_is_not_trusted() -> None:
    loop = pipeline(mode="velocity")
    drive, robot = loop.drive, loop.robot
    assert isinstance(drive, VelocityDrive)
    zero = np.zeros_like(robot.home)
    reference = at(robot.home, zero + 0.1)
    off = RobotState(robot.home - 0.01, zero, zero, None, 0.0)
    command = drive.command(reference, off, {}, 0.001)
    assert command.mode is CommandMode.VELOCITY
    np.testing.assert_allclose(command.v, 0.1 + 0.01 * FEEDBACK_GAIN)
    np.testing.assert_allclose(drive.command(reference, off, {}, 0.001, trusted=False).v, 0.1)
    far = RobotState(robot.home - 2.0, zero, zero, None, 0.0)
    np.testing.assert_allclose(drive.command(reference, far, {}, 0.001).v, robot.velocity_limit)
    last = drive.last_command(off, {})
    assert last is not None
    assert not last.v.any()


DT = 0.004


def pulled(robot: Robot, has_servos: bool) -> tuple[TorqueDrive, Reference, RobotState]:
    """Return a torque drive whose reference has moved away from the resting arms, so that the spring pulls."""
    # With a time limit, the speed of the computer would decide whether a solution is late.
    controller = CartesianController(robot, cell().control.model_copy(update={"solve_time_limit": None}))
    drive = TorqueDrive(robot, cell(), has_servos)
    zero = np.zeros_like(robot.home)
    state = RobotState(robot.home, zero, zero, None, 0.0)
    drive.reset(state)
    goal = controller.tool_pose("left")
    goal.translation = goal.translation + np.array([0.0, 0.0, 0.05])
    for _ in range(100):
        reference = controller.step({"left": goal}, DT)
        command = drive.command(reference, state, {}, DT)
    assert np.abs(command.tau - drive.impedance.gravity(robot.home)).max() > 10.0
    return drive, reference, state


def test_without_a_trusted_state_the_command_is_the_gravity_torque(robot: Robot) -> None:
    drive, reference, state = pulled(robot, has_servos=False)
    gravity = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), robot.home)
    command = drive.command(reference, state, {}, DT, trusted=False)
    assert command.mode is CommandMode.TORQUE
    np.testing.assert_allclose(command.tau, gravity, atol=1e-9)
    assert command.gravity_only
    lost = drive.command(reference, replace(state, q=np.full_like(state.q, np.nan)), {}, DT, trusted=False)
    np.testing.assert_allclose(lost.tau, gravity, atol=1e-9)
    last = drive.last_command(state, {})
    assert last is not None
    np.testing.assert_allclose(last.tau, gravity, atol=1e-9)


def test_without_a_trusted_state_a_plant_with_servos_is_commanded_to_the_positions_of_the_reference(
    robot: Robot,
) -> None:
    drive, reference, state = pulled(robot, has_servos=True)
    command = drive.command(reference, state, {}, DT, trusted=False)
    assert command.mode is CommandMode.POSITION
    np.testing.assert_array_equal(command.q, reference.q)


def test_the_wall_pushes_a_measured_pair_apart_if_the_pair_is_too_close(robot: Robot) -> None:
    drive, reference, state = pulled(robot, has_servos=False)
    # Random postures are tried until a measured pair is closer than its kept distance, and no pair touches.
    q = state.q.copy()
    rng = np.random.default_rng(3)
    kept = kept_distances(robot, cell().control).values
    while not (robot.distance_values(q).min() > 0.0 and (robot.distance_values(q) - kept).min() < -0.01):
        q = rng.uniform(robot.position_lower, robot.position_upper)
    near = replace(state, q=q)
    drive.reset(near)
    drive.command(replace(reference, q=q, v=0.0 * q, a=0.0 * q), near, {}, DT)
    wall = drive.report.wall
    assert wall is not None
    assert wall.pressing
    assert np.abs(wall.tau).max() > 1.0
