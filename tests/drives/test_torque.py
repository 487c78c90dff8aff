"""What torque mode commands while nobody knows where the arms are, with servos beside the torques and without."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.drives.base import TorqueDrive
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.types import CommandMode, Reference, RobotState

NO_CLOCK = {"solve_time_limit": None}  # whether a solution is late depends on the machine

DT = 0.004


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))


def pulled(robot: Robot, has_servos: bool) -> tuple[TorqueDrive, Reference, RobotState]:
    """A drive whose reference has left the arms, which stand still, so that the spring pulls."""
    config = load_config("config/dual_iiwa7.yaml")
    controller, drive = (
        CartesianController(robot, config.control.model_copy(update=NO_CLOCK)),
        TorqueDrive(robot, config, has_servos),
    )
    zero = np.zeros_like(robot.home)
    state = RobotState(robot.home, zero, zero, None, 0.0)
    drive.reset(state)
    goal = controller.tool_pose("left")
    goal.translation = goal.translation + np.array([0.0, 0.0, 0.05])
    for _ in range(100):
        reference = controller.step({"left": goal}, DT)
        command = drive.command(reference, state, {}, DT)
    assert np.abs(command.tau - drive.gravity(robot.home)).max() > 10.0
    return drive, reference, state


def test_without_a_state_to_trust_the_torque_is_that_of_gravity(robot: Robot) -> None:
    drive, reference, state = pulled(robot, has_servos=False)
    gravity = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), robot.home)
    command = drive.command(reference, state, {}, DT, trusted=False)
    assert command.mode is CommandMode.TORQUE
    np.testing.assert_allclose(command.tau, gravity, atol=1e-9)
    lost = drive.command(reference, replace(state, q=np.full_like(state.q, np.nan)), {}, DT, trusted=False)
    np.testing.assert_allclose(lost.tau, gravity, atol=1e-9)
    last = drive.last_command(state, {})
    assert last is not None
    np.testing.assert_allclose(last.tau, gravity, atol=1e-9)


def test_without_a_state_to_trust_a_plant_with_servos_follows_the_reference_by_those(robot: Robot) -> None:
    drive, reference, state = pulled(robot, has_servos=True)
    command = drive.command(reference, state, {}, DT, trusted=False)
    assert command.mode is CommandMode.POSITION
    np.testing.assert_array_equal(command.q, reference.q)


def test_the_wall_between_measured_links_is_part_of_the_command(robot: Robot) -> None:
    drive, reference, state = pulled(robot, has_servos=False)
    # Fold the left arm inwards until a measured pair is closer than allowed.
    q = state.q.copy()
    rng = np.random.default_rng(3)
    kept = kept_distances(robot, load_config("config/dual_iiwa7.yaml").control).values
    while not (robot.distance_values(q).min() > 0.0 and (robot.distance_values(q) - kept).min() < -0.01):
        q = rng.uniform(robot.position_lower, robot.position_upper)
    near = replace(state, q=q)
    drive.reset(near)
    drive.command(replace(reference, q=q, v=0.0 * q, a=0.0 * q), near, {}, DT)
    wall = drive.report.wall
    assert wall is not None
    assert wall.pressing
    assert np.abs(wall.tau).max() > 1.0
