"""Whatever stands in the cell is kept at a distance, whichever shape it has and whichever link comes near."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.config.cell import Config, load_config
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot
from tests.support.driven import Driven

SHAPES = {
    "box": [0.1, 0.1, 0.5],
    "cylinder": [0.06, 0.5],
    "sphere": [0.12],
    "capsule": [0.06, 0.4],
}
CELL = load_config("config/dual_iiwa7.yaml")


def _with(shape: str, position: list[float]) -> CartesianController:
    """The shipped cell with one more obstacle."""
    data = CELL.model_dump(mode="json")
    data["obstacles"]["post"] = {"shape": shape, "size": SHAPES[shape], "position": position, "rpy": [0.3, 0.2, 0.0]}
    return CartesianController(Robot.from_config(Config.model_validate(data)))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_tool_pushed_into_an_obstacle_stops_before_it_and_rests(shape: str) -> None:
    controller = _with(shape, [0.65, 0.1, 0.55])
    robot = controller.robot
    run = Driven(controller, dt=0.005)
    goal = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    goal["left"].translation = np.array([0.65, 0.1, 0.5])
    reference, contract = run.drive(4.0, goal), run.contract
    assert "post" in "|".join(reference.report.closest_pair)
    assert reference.report.closest_distance < 0.03, "it goes as near as it may"
    assert contract.tail_acceleration() < 0.1
    assert contract.fallback_share < 0.01
    assert contract.uncertified == 0
    # The shapes of the cell lie inside what is watched: Coal measures them.
    assert min(pair.distance for pair in robot.distances(reference.q)) >= 0.02 - 1e-5
