from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.errors import PlantError
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode
from tests.plants.conftest import hold


@pytest.fixture
def plant(robot: Robot, config: Config) -> KinematicPlant:
    return KinematicPlant(robot, config)


def test_the_plant_stands_at_home_with_open_grippers_until_the_first_command(
    plant: KinematicPlant, robot: Robot
) -> None:
    plant.advance(0.5)
    state = plant.state()
    np.testing.assert_array_equal(state.q, robot.home)
    np.testing.assert_array_equal(state.v, 0)
    assert plant.gripper_openings() == {"left": 1.0, "right": 1.0}


def test_the_plant_is_exactly_at_the_command_at_the_end_of_the_tick(plant: KinematicPlant, robot: Robot) -> None:
    command = replace(hold(robot.home + 0.1), v=np.full(14, 0.3))
    plant.apply(command)
    command.q[:], command.v[:] = 99, 99  # These changes of the given arrays must have no effect.
    np.testing.assert_array_equal(plant.state().q, robot.home)
    for v in (0.3, 0.0):
        plant.advance(0.001)
        np.testing.assert_array_equal(plant.state().q, robot.home + 0.1)
        np.testing.assert_array_equal(plant.state().v, v)


@pytest.mark.parametrize("dt", [0.001, 0.0037, 0.02])
def test_a_gripper_closes_at_its_speed_for_every_length_of_a_tick(
    plant: KinematicPlant, robot: Robot, dt: float
) -> None:
    plant.apply(hold(robot.home, left=0.0))
    while plant.state().stamp < 0.1:
        plant.advance(dt)
    # The speed is 0.1 m/s over a stroke of 0.025 m.
    assert plant.gripper_openings()["left"] == pytest.approx(1 - 4 * plant.state().stamp, abs=1e-9)
    for _ in range(100):
        plant.advance(dt)
    while plant.state().stamp < 0.3:
        plant.advance(dt)
    assert plant.gripper_openings() == {"left": 0.0, "right": 1.0}


def test_a_reset_clears_the_command_the_time_and_the_openings_of_grippers(plant: KinematicPlant, robot: Robot) -> None:
    plant.apply(hold(robot.home + 0.1, left=0.0))
    plant.advance(0.1)
    plant.apply(hold(robot.home + 0.2))
    plant.reset(robot.home - 0.1)
    plant.advance(0.0)
    assert plant.state().stamp == 0
    plant.advance(0.25)
    np.testing.assert_array_equal(plant.state().q, robot.home - 0.1)
    assert plant.gripper_openings() == {"left": 1.0, "right": 1.0}


def test_torque_mode_is_refused_and_the_error_says_what_is_allowed(plant: KinematicPlant, robot: Robot) -> None:
    with pytest.raises(PlantError, match=r"torque.*follows position, velocity commands only"):
        plant.apply(replace(hold(robot.home), mode=CommandMode.TORQUE))
