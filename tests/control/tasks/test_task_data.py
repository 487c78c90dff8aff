"""Two arms in each other's way: who gives way, that all stays safe and quiet, and that both get free again."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import ConfigError
from q2r2_control.verification.contract import Contract
from tests.control.scenarios import SCENARIOS, Scenario, Targets, circle
from tests.control.test_contract import robot_of, run

POLICIES = ("equal", "left", "right")
OTHER = {"left": "right", "right": "left"}


@cache
def controller_of(priority: str, robot: str = "iiwa7") -> CartesianController:
    return CartesianController(robot_of(robot), ControllerSettings(priority=priority))


def both_in_the_middle(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """Both tools are asked to be halfway between their starts, each with the other one's hand in the way."""
    return SCENARIOS["same point"](t, start)


def freed(blocked: Scenario, *arms: str) -> Scenario:
    """After 3 s of ``blocked`` the named arms are asked back to their own side."""

    def scenario(t: float, start: Mapping[str, pin.SE3]) -> Targets:
        targets = blocked(t, start)
        return targets if t < 3.0 else targets | {arm: start[arm] for arm in arms}

    return scenario


def errors(controller: CartesianController, targets: Mapping[str, pin.SE3 | None]) -> dict[str, float]:
    """Distance of each tool from its target [m]."""
    return {
        arm: float(np.linalg.norm(controller.tool_pose(arm).translation - pose.translation))
        for arm, pose in targets.items()
        if pose is not None
    }


def starts(controller: CartesianController) -> dict[str, pin.SE3]:
    return {arm: controller.robot.tool_pose(controller.robot.home, arm) for arm in controller.robot.arms}


@pytest.mark.parametrize(("priority", "robot", "dt"), [("left", "iiwa7", 0.005), ("right", "panda", 0.002)])
@pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS.keys())
def test_the_contract_holds_in_every_scenario(scenario: Any, priority: str, robot: str, dt: float) -> None:
    contract = run(controller_of(priority, robot), scenario, 2.0, dt)
    assert contract.fallback_share < 0.01
    assert contract.uncertified == 0


@pytest.mark.parametrize("priority", ["left", "right"])
@pytest.mark.parametrize(("name", "duration"), [("crossing", 10.0), ("same point", 5.0)])
def test_arms_of_which_one_gives_way_come_to_rest(name: str, duration: float, priority: str) -> None:
    contract = run(controller_of(priority), SCENARIOS[name], duration, 0.005)
    assert contract.tail_acceleration() < 0.1
    assert contract.fallback_share < 0.01


@pytest.mark.parametrize("priority", ["left", "right"])
def test_the_arm_with_priority_reaches_a_place_that_both_want_in_the_time_it_takes_alone(priority: str) -> None:
    controller = controller_of(priority)
    times = {}
    for case in ("alone", "against the other"):
        controller.reset(controller.robot.home)
        contract = Contract(controller, controller.robot.home)
        targets = both_in_the_middle(0.0, starts(controller))
        if case == "alone":
            targets[OTHER[priority]] = starts(controller)[OTHER[priority]]
        while errors(controller, targets)[priority] > 1e-3 and contract.ticks < 600:
            contract.check(controller.step(targets, 0.005), 0.005)
        times[case] = 0.005 * contract.ticks
    assert times["against the other"] < times["alone"] + 0.5
    assert times["against the other"] < 2.5
    assert errors(controller, targets)[OTHER[priority]] > 0.1


@pytest.mark.parametrize("priority", POLICIES)
@pytest.mark.parametrize(
    ("blocked", "arms"),
    [
        pytest.param(both_in_the_middle, ("left",), id="the left one leaves"),
        pytest.param(both_in_the_middle, ("right",), id="the right one leaves"),
        pytest.param(SCENARIOS["crossing"], ("left", "right"), id="both leave"),
    ],
)
def test_arms_that_blocked_each_other_reach_their_targets_once_the_way_is_free(
    blocked: Scenario, arms: tuple[str, ...], priority: str
) -> None:
    controller = controller_of(priority)
    scenario = freed(blocked, *arms)
    contract = run(controller, scenario, 3.0 + (5.0 if priority == "equal" else 3.0), 0.005)
    assert contract.fallback_share < 0.01
    assert contract.uncertified == 0
    assert max(errors(controller, scenario(9.0, starts(controller))).values()) < 1e-3


@pytest.mark.parametrize("priority", POLICIES)
def test_an_arm_without_a_target_holds_and_does_not_give_way(priority: str) -> None:
    controller = controller_of(priority)
    contract = run(controller, SCENARIOS["one arm frozen"], 4.0, 0.005)
    assert contract.tail_acceleration() < 0.1
    assert errors(controller, {"left": starts(controller)["left"]})["left"] < (4e-4 if priority == "equal" else 0.02)


def test_where_the_arms_are_far_apart_priority_changes_nothing() -> None:
    motions = []
    for priority in POLICIES:
        controller = controller_of(priority)
        controller.reset(controller.robot.home)
        start = starts(controller)
        motions.append([controller.step(circle(0.005 * tick, start), 0.005).q for tick in range(200)])
    for motion in motions[1:]:
        np.testing.assert_allclose(motion, motions[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["middle", "", "Left"])
def test_a_priority_that_is_no_arm_of_the_cell_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"control.priority = '{name}': allowed here: equal, left, right"):
        CartesianController(robot_of("iiwa7"), ControllerSettings(priority=name))
