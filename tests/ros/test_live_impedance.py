"""Stiffness and damping of arms that are commanded torques, set while the controller's node runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.waiting import wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)

from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.live_parameters import LiveImpedance
from q2r2_control.types import RobotState


def test_what_is_set_counts_for_both_arms_without_a_jump_and_what_is_not_allowed_changes_nothing(
    domain: int, robot: Robot
) -> None:
    impedance = ImpedanceController(robot, ImpedanceSettings(ramp_time=0.1))
    zero = np.zeros(robot.model.nv)
    at_home = RobotState(robot.home, zero, zero, None, 0.0)
    impedance.reset(at_home)
    with spun_node(domain) as other:
        node = BaseNode("torques", context=other.context)
        LiveImpedance(node, impedance)
        other.executor.add_node(node)
        client = AsyncParameterClient(other, "torques")

        def set_to(**values: float) -> Any:
            parameters = [Parameter(name, value=value) for name, value in values.items()]
            future = client.set_parameters_atomically(parameters)
            wait_until(future.done, "the parameters are answered")
            return future.result().result

        before = impedance.in_force("left")
        asked = {
            **{"translational_stiffness": 500.0, "rotational_stiffness": 50.0, "damping_ratio": 0.5},
            **{"nullspace_stiffness": 10.0, "nullspace_damping_ratio": 0.7},
        }
        assert set_to(**asked).successful
        for name, value in {"translational_stiffness": 9000.0, "damping_ratio": 0.0}.items():
            refused = set_to(nullspace_stiffness=20.0, **{name: value})
            assert not refused.successful
            assert name in refused.reason
        node.destroy_node()
    assert [impedance.in_force(arm) for arm in robot.arms] == [before] * 2  # until the arms are commanded
    impedance.reset(at_home)
    assert [impedance.in_force(arm) for arm in robot.arms] == [asked] * 2
