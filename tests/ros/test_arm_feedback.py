"""What the controller's node says of arms to those that make hands feel it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot
from q2r2_control.loop.control_loop import ArmConditions
from q2r2_control.types import SIDES, ActiveLimit, LimitKind, RobotState
from tests.ros.conftest import need_ros
from tests.ros.waiting import wait_until

need_ros()

from q2r2_control.ros.bridge.arm_feedback import ConditionPublishers, listen_to_condition
from q2r2_control.teleop.haptics import ArmCondition

PUSH = np.array([0.0, 0.0, 20.0])  # at the left tool [N]


def test_nearness_limits_and_contact_of_each_arm_are_told_as_they_are(node: Any, robot: Robot) -> None:
    controller = CartesianController(robot)
    controller.reset(robot.home)
    told: dict[str, ArmCondition] = {}
    for arm in SIDES:
        listen_to_condition(node, "/test", arm, partial(told.__setitem__, arm))
    publishers = ConditionPublishers(node, SIDES, ArmConditions(controller))
    zero, data = np.zeros_like(robot.home), robot.model.createData()
    frame = robot.arms["left"].frame_id
    J = pin.computeFrameJacobian(robot.model, data, robot.home, frame, pin.LOCAL_WORLD_ALIGNED)
    felt = RobotState(q=robot.home, v=zero, tau=zero, tau_external=J[:3].T @ PUSH, stamp=0.0)
    binding = ActiveLimit(LimitKind.POSITION, ("left_A4",)), ActiveLimit(LimitKind.VELOCITY, ("right_A2",))
    report = replace(controller.step({}, 0.004).report, binding=binding)
    now = 0.0

    def comes(state: RobotState) -> bool:
        nonlocal now
        now += 0.05
        publishers.update(report, state, now)
        left = told.get("left")
        return left is not None and len(told) == 2 and (left.force is None) is (state.tau_external is None)

    wait_until(lambda: comes(felt), "both arms are told of")
    assert told["left"].force == pytest.approx(20.0, rel=0.01)
    assert told["right"].force == pytest.approx(0.0, abs=1e-6)
    assert (told["left"].limits, told["right"].limits) == ({"left_A4"}, set())
    for arm in SIDES:
        assert told[arm].spare == pytest.approx(controller.spare_distance(arm))
    wait_until(lambda: comes(replace(felt, tau_external=None)), "no force is told where none is measured")
