"""Parameters that are set while an arm moves: no jump, what counts from then on, what is refused as a whole and why."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from tests.ros.conftest import need_ros
from tests.ros.processes import Processes
from tests.ros.waiting import wait_until

need_ros()

from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from q2r2_control import CartesianController, Robot
from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.live_parameters import make_control_live, make_impedance_live
from q2r2_control.ros.nodes.arm_controllers import LeftArmController
from q2r2_control.types import RobotState
from tests.ros.arm_rig import ArmRig, assert_same, offset, steps


def set_in(node: Any, **values: Any) -> Any:
    """The result; ``__`` in a name stands for a dot."""
    parameters = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
    return node.set_parameters_atomically(parameters)


def test_scale_and_guard_that_are_set_in_motion_count_from_then_on_and_nothing_jumps(
    node: Any, processes: Processes
) -> None:
    rig = ArmRig(node)
    rig.start(processes)
    client = AsyncParameterClient(node, "left_q2r2_arm_controller")

    def set_to(values: dict[str, Any]) -> Any:
        future = client.set_parameters_atomically([Parameter(name, value=value) for name, value in values.items()])
        wait_until(future.done, "the parameters are answered")
        return future.result().result

    rig.engage()
    before = rig.wait_for_rest()
    assert set_to({"teleop.position_scale": 0.5, "teleop.filter.smoothing_delay": 0.05}).successful
    refused = set_to({"teleop.position_scale": 1.0, "teleop.chord_window": 0.2})
    assert "may be changed while both arms hold" in refused.reason
    rig.move((0.1, 0.0, 0.0))
    assert_same(rig.wait_for_rest(), offset(before, (0.05, 0.0, 0.0)), 1e-3)
    assert rig.state["engaged"]
    assert max(steps(rig.targets)) < 0.01
    assert set_to({"guard.max_velocity": 0.05, "guard.max_acceleration": 2.0}).successful
    began, before = time.monotonic(), rig.newest()
    rig.move((0.12, 0.0, 0.0))
    way = np.linalg.norm(rig.newest().translation - before.translation)
    assert way < 0.05 * (time.monotonic() - began)  # of 0.06 m that are asked for
    assert_same(rig.wait_for_rest(), offset(before, (0.06, 0.0, 0.0)), 1e-3)


def test_what_cannot_be_set_is_refused_with_the_reason_and_changes_nothing(context: Any) -> None:
    node = LeftArmController(context=context)
    for values, reason in (
        ({"teleop__position_scale": 0.5, "teleop__precision_scale": 7.0}, "precision_scale"),
        ({"teleop__position_scale": 0.5, "teleop__axis_scales": [1.0, 2.0]}, "teleop.axis_scales"),
        ({"guard__max_velocity": 0.3, "guard__max_angular_velocity": 0.0}, "guard.max_angular_velocity"),
        ({"mirror_reflected": True}, "allowed with mirror = True only"),
    ):
        before = node.parameters
        result = set_in(node, **values)
        assert not result.successful
        assert reason in result.reason
        assert node.parameters == before
    assert set_in(node, mirror=True, mirror_reflected=True).successful
    assert (node.hand, node.health()[2]["stance"]) == ("right", "mirror_reflected")
    node.destroy_node()


def test_distances_and_gains_of_the_controller_are_set_together_or_not_at_all(context: Any, robot: Robot) -> None:
    node, controller = BaseNode("controller", context=context), CartesianController(robot)
    make_control_live(node, controller)
    assert set_in(node, control__min_distance=0.03, control__position_gain=4.0, control__stretch_gain=20.0).successful
    for values, reason in (
        ({"control__min_distance": 0.045, "control__position_gain": 8.0}, "hand_e_envelope_0 are 41.6 mm apart"),
        ({"control__posture_gain": 1000.0}, "posture_gain"),
        ({"control__separation_gain": 0.0}, "separation_gain = 0.0"),
    ):
        refused = set_in(node, **values)
        assert not refused.successful
        assert reason in refused.reason
    names = ("min_distance", "position_gain", "stretch_gain")
    assert [node.get_parameter(f"control.{name}").value for name in names] == [0.03, 4.0, 20.0]
    node.destroy_node()


def test_an_impedance_that_is_set_counts_for_both_arms_and_what_is_not_allowed_changes_nothing(
    context: Any, robot: Robot
) -> None:
    impedance = ImpedanceController(robot, ImpedanceSettings(ramp_time=0.1))
    zero = np.zeros(robot.model.nv)
    at_home = RobotState(robot.home, zero, zero, None, 0.0)
    impedance.reset(at_home)
    node = BaseNode("torques", context=context)
    make_impedance_live(node, impedance)
    before = impedance.in_force("left")
    asked = {
        **{"translational_stiffness": 500.0, "rotational_stiffness": 50.0, "damping_ratio": 0.5},
        **{"nullspace_stiffness": 10.0, "nullspace_damping_ratio": 0.7},
    }
    assert set_in(node, **asked).successful
    for name, value in {"translational_stiffness": 9000.0, "damping_ratio": 0.0}.items():
        refused = set_in(node, nullspace_stiffness=20.0, **{name: value})
        assert not refused.successful
        assert name in refused.reason
    node.destroy_node()
    assert [impedance.in_force(arm) for arm in robot.arms] == [before] * 2  # until the arms are commanded
    impedance.reset(at_home)
    assert [impedance.in_force(arm) for arm in robot.arms] == [asked] * 2
