"""The cell behind the cabinets that stand in: it moves as they are commanded."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.plants.fri.cabinet_server import SimulatedArms, settings_of
from q2r2_control.plants.fri.wire import CommandKind
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES

PERIOD = 0.005


@pytest.mark.parametrize("overlay", [None, (0.0,) * 7], ids=["position", "torque"])
def test_an_arm_goes_where_its_cabinet_commands_and_the_other_one_stays(
    config: Config, robot: Robot, overlay: tuple[float, ...] | None
) -> None:
    cell = SimulatedArms(robot, config)
    start = {arm: np.array(cell.arms[arm].q) for arm in SIDES}
    for tick in range(1, 201):
        goal = start["left"] + np.array([0.1 * min(tick, 100) / 100, 0, 0, 0, 0, 0, 0])
        cell.advance(tick * PERIOD)
        cell.arms["left"].advance(PERIOD, tuple(goal), None)
        cell.arms["right"].advance(PERIOD, tuple(start["right"]), overlay)
    np.testing.assert_allclose(cell.arms["left"].q, start["left"] + [0.1, 0, 0, 0, 0, 0, 0], atol=0.01)
    np.testing.assert_allclose(cell.arms["right"].q, start["right"], atol=0.02)


def test_the_guards_leave_the_reference_room_for_catching_up(robot: Robot) -> None:
    settings = settings_of(robot, "left", CommandKind.POSITION, 2, PERIOD)
    joints = robot.arms["left"].joints
    assert (np.array(settings.acceleration) > 1.1 * robot.acceleration_limit[joints]).all()
    assert settings.velocity == tuple(robot.velocity_limit[joints])
