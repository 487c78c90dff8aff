"""Settings of arms and of the controller come from the YAML or from parameters. Changes of settings cause no jump."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.ros.conftest import need_ros
from tests.ros.processes import Processes, as_arguments, wait_until
from tests.support.external_cell import external

need_ros()

from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

from q2r2_control import CartesianController, Robot
from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.errors import ConfigError
from q2r2_control.ros import BaseArmController
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.live_parameters import make_control_live, make_impedance_live
from q2r2_control.ros.bridge.messages import stamped_pose
from q2r2_control.ros.nodes.arm_controllers import LeftArmController, RightArmController
from q2r2_control.ros.reasons import RosReason
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import RobotState
from tests.ros.arm_rig import TOOL, ArmRig, assert_same, offset, steps, target_of


def set_in(node: Any, **values: Any) -> Any:
    """Set parameters and return the result; ``__`` in a name stands for a dot."""
    parameters = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
    return node.set_parameters_atomically(parameters)


def test_scale_and_guard_settings_that_change_during_motion_apply_without_a_jump(
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
    assert TeleopReason.ARMS_MUST_HOLD.template in refused.reason
    rig.move((0.1, 0.0, 0.0))
    assert_same(rig.wait_for_rest(), offset(before, (0.05, 0.0, 0.0)), 1e-3)
    assert rig.state["engaged"]
    assert max(steps(rig.targets)) < 0.01
    assert set_to({"guard.max_velocity": 0.05, "guard.max_acceleration": 2.0}).successful
    began, before = time.monotonic(), rig.newest()
    rig.move((0.12, 0.0, 0.0))
    way = np.linalg.norm(rig.newest().translation - before.translation)
    assert way < 0.05 * (time.monotonic() - began)  # The hand moves the target by 0.06 m.
    assert_same(rig.wait_for_rest(), offset(before, (0.06, 0.0, 0.0)), 1e-3)


def test_an_impossible_setting_is_refused_with_the_reason_and_changes_nothing(context: Any) -> None:
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


def test_permitted_impedance_settings_apply_to_both_arms_and_settings_that_are_not_permitted_are_refused(
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
    # The change has not yet taken effect, because the arms were not commanded since.
    assert [impedance.in_force(arm) for arm in robot.arms] == [before] * 2
    impedance.reset(at_home)
    assert [impedance.in_force(arm) for arm in robot.arms] == [asked] * 2


def test_a_cells_yaml_names_the_external_controller_and_parameters_override_it(
    context: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    cell = external()
    cell["external"] |= {"preset": "fzi", "mode": "raw", "rate": 60.0, "limits": {"max_velocity": 0.2}}
    cell["teleop"] |= {"stance": "mirror_reflected", "position_scale": 0.5}
    config = tmp_path / "cell.yaml"
    config.write_text(yaml.safe_dump(cell))
    arguments = as_arguments(f"config:={config}", "guard.max_acceleration:=1.0")
    made = RightArmController(context=context, cli_args=arguments)
    values = made.parameters
    assert (values.preset.name, values.mode, values.rate) == ("fzi", "raw", 60.0)
    assert capfd.readouterr().err.count("raw: no limits, no distances, no self-collision") == 1
    assert (values.teleop.stance, values.teleop.position_scale) == ("mirror_reflected", 0.5)
    assert values.target_topic == "/bh_robot/right_arm_clik_controller/target_frame"
    assert (values.base_frame, values.world_frame, values.tool_frame) == (
        "bh_robot_base",
        "bh_robot_base",
        "right_arm_link_ee",
    )
    assert values.gripper_topic == "/bh_robot/right_arm_gripper_action_controller/gripper_cmd"
    assert (values.guard.max_velocity, values.guard.max_acceleration) == (0.2, 1.0)
    assert values.guard.max_angular_velocity == values.preset.guard.max_angular_velocity
    made.destroy_node()

    del cell["external"]["arms"]["right"], cell["arms"]["right"]
    config.write_text(yaml.safe_dump(cell))
    with pytest.raises(ConfigError, match=r"cell\.yaml has no arm right; allowed: left"):
        RightArmController(context=context, cli_args=arguments)


def test_a_subclass_may_mirror_its_arm_and_give_its_filter_in_samples(context: Any) -> None:
    made = BaseArmController("right", "bh_robot", mirror=True, filter_window_size=4, context=context)
    assert made.get_name() == "right_bh_robot_arm_controller"
    assert (made.parameters.teleop.stance, made.hand) == ("mirror", "left")
    # The delay is half of 4 - 1 periods.
    assert made.parameters.teleop.filter.smoothing_delay == pytest.approx(1.5 / 75.0)
    made.destroy_node()


def test_if_the_tool_pose_of_an_arm_comes_on_a_topic_the_arm_pauses_when_the_topic_is_silent(
    rig: ArmRig, node: Any, processes: Processes
) -> None:
    rig.sends_tool = False
    publisher = node.create_publisher(PoseStamped, "/left/current_pose", 10)
    timer = node.create_timer(0.01, lambda: publisher.publish(stamped_pose(rig.tool, "world", 0.0)))
    rig.start(processes, {"current_pose_topic": "/left/current_pose"})
    rig.engage()
    rig.wait(lambda: rig.targets, "targets come")
    assert_same(target_of(rig), TOOL, 1e-9)
    rig.move((0.05, 0.0, 0.0))
    assert_same(rig.wait_for_rest(), offset(TOOL, (0.05, 0.0, 0.0)), 1e-3)
    node.destroy_timer(timer)
    rig.wait(lambda: rig.state["state"] == "lost", "an arm without tool poses is paused")
    assert rig.state["last_event_kind"] == RosReason.TOPIC_SILENT
    assert "/left/current_pose from /test" in rig.state["last_event"]


# The first preset takes poses. The second preset takes joint commands of the built-in controller.
@pytest.mark.parametrize("preset", ["fzi", "jtc"])
def test_an_arm_is_not_engaged_while_the_safe_target_is_far_from_its_tool(
    rig: ArmRig, node: Any, processes: Processes, preset: str
) -> None:
    safe = offset(TOOL, (0.0, 0.0, 0.15))  # A wrong tool_frame would cause this distance.
    publisher = node.create_publisher(PoseStamped, "/cartesian_controller/safe_target/left", 10)
    timer = node.create_timer(0.01, lambda: publisher.publish(stamped_pose(safe, "world", 0.0)))
    node.create_subscription(PoseStamped, "/theirs/target_frame", lambda _: None, 10)
    process = rig.start(processes, {"mode": "filtered", "preset": preset, "target_topic": "/theirs/target_frame"})
    rig.wait(lambda: rig.state.get("kind") == RosReason.CONTROLLER_REFUSES, "the arm is not ready")
    rig.press()
    rig.wait(lambda: rig.state["last_event_kind"] == RosReason.SAFE_TARGET_AWAY, "the press is refused")
    says = "safe_target/left is 0.150 m and 0.00 rad from left_tool_frame: the arm moves, or left_tool_frame is not the"
    assert says in rig.state["last_event"]
    # The line is printed once, and not at every tick.
    assert process.output.count(f"controller]: /cartesian_controller/{says}") == 1
    assert not rig.targets
    safe = TOOL
    rig.engage()
    node.destroy_timer(timer)


def test_a_hand_feels_a_target_that_slips_on_its_leash(rig: ArmRig, processes: Processes) -> None:
    rig.follows = False  # The arm behaves as if an obstacle were in the way.
    rig.start(processes, {"teleop.leash.distance": 0.05})
    rig.engage()
    rig.wait(lambda: (0.0, 0.0) in rig.pulses, "engaging is felt")
    rig.pulses.clear()
    rig.move((0.04, 0.0, 0.0))
    rig.wait_for_rest()
    assert rig.pulses == []
    rig.move((0.09, 0.0, 0.0), 0.6)
    rig.wait(lambda: rig.pulses.count((0.2, 0.2)) >= 3, "every two centimetres of slip are felt")
    rig.wait(lambda: rig.state["slip"] > 0.06, "the slip is reported")
    assert set(rig.pulses) == {(0.2, 0.2), (0.0, 0.0)}
    assert np.linalg.norm(rig.wait_for_rest().translation - TOOL.translation) < 0.051
