"""If two arms block each other, their priority decides which arm gives way. Both stay safe and come to rest.

They move on as soon as the path is free.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import ConfigError
from tests.control.scenarios import SCENARIOS, circle
from tests.control.test_scenarios import robot_of
from tests.support.driven import Driven, Targets

POLICIES = ("equal", "left", "right")
OTHER = {"left": "right", "right": "left"}


@cache
def controller_of(priority: str) -> CartesianController:
    return CartesianController(robot_of("iiwa7"), ControllerSettings(priority=priority))


def errors(run: Driven, targets: Targets) -> dict[str, float]:
    """Return the distance of each tool from its target [m]."""
    poses = {arm: pose for arm, pose in targets.items() if pose is not None}
    tools = {arm: run.controller.tool_pose(arm).translation for arm in poses}
    return {arm: float(np.linalg.norm(tools[arm] - pose.translation)) for arm, pose in poses.items()}


@pytest.mark.parametrize(("name", "duration"), [("crossing", 10.0), ("same point", 5.0)])
def test_two_arms_with_a_priority_come_to_rest(name: str, duration: float) -> None:
    run = Driven(controller_of("left"), dt=0.005)
    run.drive(duration, SCENARIOS[name])
    assert run.contract.tail_acceleration() < 0.1
    assert run.contract.fallback_share < 0.01


@pytest.mark.parametrize("priority", ["left", "right"])
def test_if_both_arms_have_one_target_the_arm_with_priority_reaches_it_nearly_as_fast_as_alone(priority: str) -> None:
    times = {}
    for case in ("alone", "against the other"):
        run = Driven(controller_of(priority), dt=0.005)
        targets = SCENARIOS["same point"](0.0, run.start)
        if case == "alone":
            targets[OTHER[priority]] = run.start[OTHER[priority]]
        while errors(run, targets)[priority] > 1e-3 and run.ticks < 600:
            run.drive(0.005, targets)
        times[case] = 0.005 * run.ticks
    assert times["against the other"] < min(times["alone"] + 0.5, 2.5)
    assert errors(run, targets)[OTHER[priority]] > 0.1


@pytest.mark.parametrize(
    ("blocked", "arms", "priority"),
    [
        pytest.param("same point", ("left",), "left", id="the one with priority leaves"),
        pytest.param("same point", ("right",), "left", id="the other one leaves"),
        pytest.param("crossing", ("left", "right"), "left", id="both leave"),
        pytest.param("same point", ("left",), "equal", id="one of two that are equal leaves"),
        pytest.param("crossing", ("left", "right"), "equal", id="both of two that are equal leave"),
    ],
)
def test_arms_that_blocked_each_other_reach_their_targets_when_the_path_is_free(
    blocked: str, arms: tuple[str, ...], priority: str
) -> None:
    run = Driven(controller_of(priority), dt=0.005)
    run.drive(3.0, SCENARIOS[blocked])
    targets = SCENARIOS[blocked](0.0, run.start) | {arm: run.start[arm] for arm in arms}
    run.drive(5.0 if priority == "equal" else 3.0, targets)
    assert run.contract.fallback_share < 0.01
    assert run.contract.uncertified == 0
    assert max(errors(run, targets).values()) < 1e-3


@pytest.mark.parametrize("priority", ["equal", "right"])
def test_an_arm_without_a_target_holds_its_posture_and_does_not_give_way(priority: str) -> None:
    run = Driven(controller_of(priority), dt=0.005)
    run.drive(4.0, SCENARIOS["one arm frozen"])
    assert run.contract.tail_acceleration() < 0.1
    assert errors(run, {"left": run.start["left"]})["left"] < (4e-4 if priority == "equal" else 0.02)


def test_priority_changes_nothing_if_the_arms_are_far_apart() -> None:
    first, *others = (Driven(controller_of(priority), dt=0.005).drive(1.0, circle).q for priority in POLICIES)
    for other in others:
        np.testing.assert_allclose(other, first, rtol=0, atol=1e-6)


def test_a_priority_of_an_unknown_arm_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"control\.priority = 'middle': allowed here: equal, left, right"):
        CartesianController(robot_of("iiwa7"), ControllerSettings(priority="middle"))
