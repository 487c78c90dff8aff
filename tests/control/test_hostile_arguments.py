"""No argument makes a tick raise an exception. Other calls, such as a reset, raise only the documented exceptions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.config.control import ControllerSettings
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.types import SIDES
from q2r2_control.verification.contract import Contract
from tests.support.hostile_values import HOSTILE


@pytest.fixture(params=HOSTILE.values(), ids=list(HOSTILE))
def hostile(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot, ControllerSettings(moving_obstacles=("hand",)))


@pytest.fixture(scope="module")
def shared_contract(controller: CartesianController) -> Contract:
    return Contract(controller)


@pytest.fixture
def contract(robot: Robot, controller: CartesianController, shared_contract: Contract) -> Iterator[Contract]:
    """Let the arms move before and after the test, and check the contract. Return the contract."""
    controller.reset(robot.home)
    shared_contract.start(robot.home)
    going_on(shared_contract, controller)
    yield shared_contract
    going_on(shared_contract, controller)


def going_on(contract: Contract, controller: CartesianController) -> None:
    pose = controller.tool_pose("left")
    for _ in range(10):
        contract.check(controller.step({"left": pin.SE3(pose.rotation, pose.translation + 0.1)}, 0.002), 0.002)


def test_no_dt_makes_a_tick_raise_an_exception(
    contract: Contract, controller: CartesianController, hostile: Any
) -> None:
    contract.check(controller.step({}, hostile), 0.0)


def test_no_target_makes_a_tick_raise_an_exception(
    contract: Contract, controller: CartesianController, hostile: Any
) -> None:
    for arm in SIDES:
        contract.check(controller.step({arm: hostile}, 0.002), 0.002)


def test_no_posture_makes_a_tick_raise_an_exception(
    contract: Contract, controller: CartesianController, hostile: Any
) -> None:
    contract.check(controller.step({}, 0.002, hostile), 0.002)


def test_no_given_solution_makes_a_tick_raise_an_exception(
    contract: Contract, controller: CartesianController, hostile: Any
) -> None:
    contract.check(controller.advance(hostile, {}, 0.002), 0.002)


def test_complex_numbers_are_refused_and_not_reduced_to_their_real_parts(controller: CartesianController) -> None:
    with pytest.raises(RobotError, match="finite numbers"):
        controller.reset(np.zeros(14, dtype=complex))
    assert controller.advance(np.zeros(14, dtype=complex), {}, 0.002).report.unsolved == 1


def test_targets_that_are_not_a_mapping_are_refused_and_nothing_moves(
    contract: Contract, controller: CartesianController, hostile: Any
) -> None:
    if not isinstance(hostile, Mapping):
        with pytest.raises(RobotError, match="targets"):
            controller.step(hostile, 0.002)


@pytest.mark.parametrize(
    "call",
    [
        lambda controller, value: controller.reset(value),
        lambda controller, value: controller.reset(np.zeros(14), value),
        lambda controller, value: controller.hold_at(value),
        lambda controller, value: controller.withdraw(value),
        lambda controller, value: controller.change({"min_distance": value}),
        lambda controller, value: controller.change({"position_gain": value}),
        lambda controller, value: controller.tool_pose(value),
        lambda controller, value: controller.set_opening(value, 0.0, 1.0),
        lambda controller, value: controller.set_opening("left", value, 1.0),
        lambda controller, value: controller.set_opening("left", 0.0, value),
        lambda controller, value: controller.set_holding(value, True),
        lambda controller, value: controller.move_obstacle(value, None),
        lambda controller, value: controller.move_obstacle("hand", value),
    ],
    ids=["reset q", "reset v", "hold_at", "withdraw", "change distance", "change gain", "tool_pose", "opening arm",
         "opening from", "opening to", "holding arm", "obstacle name", "obstacle"],
)  # fmt: skip
def test_calls_other_than_a_tick_raise_only_errors_of_this_package_and_the_next_tick_keeps_the_contract(
    robot: Robot, controller: CartesianController, shared_contract: Contract, hostile: Any, call: Any
) -> None:
    controller.reset(robot.home)
    with suppress(RobotError, ConfigError):
        call(controller, hostile)
    controller.reset(robot.home)
    shared_contract.start(robot.home)
    shared_contract.check(controller.step({}, 0.002), 0.002)
