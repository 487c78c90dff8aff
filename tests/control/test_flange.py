"""A flange that sticks out of the last link: its body keeps off the table and the other arm at every tick."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.config.cell import Config
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract
from tests.control.scenarios import Scenario, Targets, into_the_table, same_point

TOUCH = {"model": "media_flange_touch_pneumatic"}
DT = 0.005
# The body itself, which the model's sphere encloses: radius, length and middle from the end of the plain flanges [m].
BODY = ((0.055, 0.045, -0.0225), (0.0329, 0.026, 0.013))


def bare_arms(flange: dict[str, Any]) -> Config:
    """The shipped cell without hands."""
    data = load_config("config/dual_iiwa7.yaml").model_dump()
    for arm in data["arms"].values():
        arm |= {"flange": flange, "tool": {"link": "link_ee"}, "gripper": {}}
    data["control"]["solve_time_limit"] = None
    return Config.model_validate(data)


class Bodies:
    """The flanges' bodies as they are, and all that is not the arm that carries them."""

    def __init__(self, robot: Robot) -> None:
        self._model, self._data = robot.model, robot.model.createData()
        self._ends = {side: robot.model.getFrameId(f"{side}_link_ee", pin.FrameType.BODY) for side in robot.arms}
        self._objects = robot.collision_model.geometryObjects

    def nearest(self, q: Array) -> float:
        """Least distance of a body from the table, the floor, the other arm's links and its flange [m]."""
        pin.forwardKinematics(self._model, self._data, q)
        pin.updateFramePlacements(self._model, self._data)
        distances = []
        for side, other in (("left", "right"), ("right", "left")):
            against = [*self._of_cell(other), *self._of(other)]
            for (shape, place), (body, there) in product(self._of(side), against):
                result = coal.DistanceResult()
                distances.append(coal.distance(shape, place, body, there, coal.DistanceRequest(), result))
        return min(distances)

    def _of(self, side: str) -> Iterator[tuple[coal.CollisionGeometry, coal.Transform3s]]:
        end = self._data.oMf[self._ends[side]]
        for radius, length, middle in BODY:
            yield coal.Cylinder(radius, length), _transform(end * pin.SE3(np.eye(3), np.array([0.0, 0.0, middle])))

    def _of_cell(self, side: str) -> Iterator[tuple[coal.CollisionGeometry, coal.Transform3s]]:
        for item in self._objects:
            if item.name in ("table_0", "floor_0") or item.name.startswith(f"{side}_link"):
                yield item.geometry, _transform(self._data.oMi[item.parentJoint] * item.placement)


def _transform(pose: pin.SE3) -> coal.Transform3s:
    return coal.Transform3s(pose.rotation, pose.translation)


def tilted(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """Into the table on the flange's rim."""
    turn = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.8, 0.0), np.zeros(3))
    return {side: pose and pose * turn for side, pose in into_the_table(t, start).items()}


def facing(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """Each flange is asked to point at the other arm and to be at one place with the other one."""
    aside = {side: pin.rpy.rpyToMatrix(sign * np.pi / 2, 0.0, 0.0) for side, sign in (("left", 1), ("right", -1))}
    return {side: pose and pin.SE3(aside[side], pose.translation) for side, pose in same_point(t, start).items()}


def nearest_of(flange: dict[str, Any], scenario: Scenario, ticks: int) -> float:
    """Least distance of a body at all ticks of a scenario, in a cell that knows ``flange``."""
    config = bare_arms(flange)
    controller = CartesianController(Robot.from_config(config), config.control)
    contract, bodies = Contract(controller), Bodies(controller.robot)
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    least = np.inf
    for tick in range(ticks):
        reference = controller.step(scenario(tick * DT, start), DT)
        contract.check(reference, DT)
        least = min(least, bodies.nearest(reference.q))
    assert not np.array_equal(reference.q, controller.robot.home)
    return least


@pytest.mark.parametrize("scenario", [into_the_table, tilted, facing], ids=lambda scenario: scenario.__name__)
def test_the_body_of_a_flange_keeps_its_distance_at_every_tick(scenario: Scenario) -> None:
    least = nearest_of(TOUCH, scenario, 500)
    assert 0.02 <= least < 0.05, "it came near"


def test_a_cell_that_does_not_know_of_the_flange_brings_it_too_near() -> None:
    assert nearest_of({}, into_the_table, 500) < 0.012
