from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.errors import PlantError
from q2r2_control.plants.base import Plant
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode
from tests.plants.conftest import hold


def _with(value: float, index: int = 3) -> Array:
    values = np.zeros(14)
    values[index] = value
    return values


BAD_COMMANDS: dict[str, tuple[Callable[[Command], Command], str]] = {
    "NaN position": (lambda c: replace(c, q=_with(np.nan)), "command q: left_A4 = nan"),
    "infinite position": (lambda c: replace(c, q=_with(np.inf)), "command q: left_A4 = inf"),
    "NaN velocity": (lambda c: replace(c, v=_with(np.nan, 7)), "command v: right_A1 = nan"),
    "too few positions": (lambda c: replace(c, q=np.zeros(7)), r"command q has shape \(7,\); expected \(14,\)"),
    "a matrix of positions": (lambda c: replace(c, q=np.zeros((14, 1))), r"shape \(14, 1\)"),
    "NaN opening": (lambda c: replace(c, grippers={"left": np.nan}), "arm left = nan: allowed: 0"),
    "opening beyond open": (lambda c: replace(c, grippers={"right": 1.5}), "arm right = 1.5"),
    "negative opening": (lambda c: replace(c, grippers={"right": -0.1}), "arm right = -0.1"),
    "gripper of no arm": (lambda c: replace(c, grippers={"middle": 0.5}), "no arm 'middle'; arms: left, right"),
}


@pytest.fixture(params=["kinematic", "mujoco"])
def any_plant(request: pytest.FixtureRequest, robot: Robot, config: Config, plant: MujocoPlant) -> Plant:
    return plant if request.param == "mujoco" else KinematicPlant(robot, config)


@pytest.mark.parametrize(("spoil", "message"), BAD_COMMANDS.values(), ids=BAD_COMMANDS)
def test_a_bad_command_changes_nothing(
    any_plant: Plant, robot: Robot, spoil: Callable[[Command], Command], message: str
) -> None:
    any_plant.apply(hold(robot.home + 0.005, left=0.5))
    any_plant.advance(0.001)
    with pytest.raises(PlantError, match=message):
        any_plant.apply(spoil(hold(robot.home - 0.3, left=1.0)))
    for _ in range(600):
        any_plant.advance(0.001)
    np.testing.assert_allclose(any_plant.state().q, robot.home + 0.005, atol=1e-4)
    assert any_plant.gripper_openings()["left"] == pytest.approx(0.5, abs=0.01)


def test_a_torque_that_is_not_finite_is_refused(plant: MujocoPlant, robot: Robot) -> None:
    with pytest.raises(PlantError, match="command tau: left_A1 = nan"):
        plant.apply(replace(hold(robot.home), mode=CommandMode.TORQUE, tau=_with(np.nan, 0)))


@pytest.mark.parametrize("q", [np.full(14, np.nan), np.zeros(3)], ids=["NaN", "too short"])
def test_reset_to_a_bad_posture_is_refused(any_plant: Plant, q: Array) -> None:
    with pytest.raises(PlantError, match="reset q"):
        any_plant.reset(q)
