"""Settings of an arm controller: from a cell's YAML, and topics in place of /tf and actions; real processes."""

from __future__ import annotations

from pathlib import Path
from queue import Queue
from typing import Any

import numpy as np
import pytest
import yaml

from tests.ros.conftest import need_ros
from tests.ros.processes import PATIENCE, Processes
from tests.support.external_cell import external

need_ros()

from geometry_msgs.msg import PoseStamped
from std_msgs.msg import Float64MultiArray

from q2r2_control.errors import ConfigError
from q2r2_control.ros import BaseArmController
from q2r2_control.ros.bridge.messages import stamped_pose
from q2r2_control.ros.nodes.arm_controllers import RightArmController
from tests.ros.arm_rig import TOOL, ArmRig, assert_same, first, offset


@pytest.fixture
def rig(node: Any) -> ArmRig:
    return ArmRig(node)


def test_a_cells_yaml_names_the_external_controller_and_parameters_change_that(context: Any, tmp_path: Path) -> None:
    cell = external()
    cell["external"] |= {"preset": "fzi", "rate": 60.0, "limits": {"max_velocity": 0.2}}
    cell["teleop"] |= {"stance": "mirror_reflected", "position_scale": 0.5}
    config = tmp_path / "cell.yaml"
    config.write_text(yaml.safe_dump(cell))
    arguments = ["--ros-args", "-p", f"config:={config}", "-p", "guard.max_acceleration:=1.0"]
    made = RightArmController(context=context, cli_args=arguments)
    values = made.parameters
    assert (values.preset.name, values.mode, values.rate) == ("fzi", "raw", 60.0)
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
    assert made.parameters.teleop.filter.smoothing_delay == pytest.approx(1.5 / 75.0)  # half of 4 - 1 periods
    made.destroy_node()


def test_a_tool_on_a_topic_is_engaged_where_it_is_and_paused_when_the_topic_ends(
    rig: ArmRig, node: Any, processes: Processes
) -> None:
    rig.sends_tool = False
    publisher = node.create_publisher(PoseStamped, "/left/current_pose", 10)
    timer = node.create_timer(0.01, lambda: publisher.publish(stamped_pose(rig.tool, "world", 0.0)))
    rig.start(processes, {"current_pose_topic": "/left/current_pose"})
    rig.engage()
    rig.wait(lambda: rig.targets, "targets come")
    assert_same(first(rig), TOOL, 1e-9)
    rig.move((0.05, 0.0, 0.0))
    assert_same(rig.wait_for_rest(), offset(TOOL, (0.05, 0.0, 0.0)), 1e-3)
    node.destroy_timer(timer)
    rig.wait(lambda: rig.state["state"] == "lost", "an arm without tool poses is paused")
    rig.wait(lambda: "/left/current_pose from /test is silent" in rig.state["message"], "the reason is reported")


def test_an_arm_is_not_engaged_while_the_built_in_controllers_tool_is_elsewhere(
    rig: ArmRig, node: Any, processes: Processes
) -> None:
    safe = offset(TOOL, (0.0, 0.0, 0.15))  # as with a tool_frame that is not the cell's
    publisher = node.create_publisher(PoseStamped, "/cartesian_controller/safe_target/left", 10)
    timer = node.create_timer(0.01, lambda: publisher.publish(stamped_pose(safe, "world", 0.0)))
    node.create_subscription(PoseStamped, "/theirs/target_frame", lambda _: None, 10)
    rig.start(processes, {"mode": "filtered", "preset": "fzi", "target_topic": "/theirs/target_frame"})
    rig.wait(lambda: rig.state.get("kind") == "controller_refuses", "the arm is not ready")
    assert "is not where the tool is" in rig.state["message"]
    rig.press()
    rig.wait(lambda: rig.state["last_event_kind"] == "controller_refuses", "the press is refused")
    assert not rig.targets
    safe = TOOL
    rig.engage()
    node.destroy_timer(timer)


def test_a_gripper_behind_a_topic_gets_its_positions(rig: ArmRig, node: Any, processes: Processes) -> None:
    commands: Queue[list[float]] = Queue()
    node.create_subscription(Float64MultiArray, "/left/fingers", lambda message: commands.put(list(message.data)), 10)
    given = {"action_type": "Float64MultiArray", "open_position": 0.1, "closed_position": 0.8}
    names = {f"gripper.{key}": value for key, value in given.items()}
    rig.start(processes, {"gripper_action_topic": "/left/fingers", **names})
    rig.press("upper")
    assert commands.get(timeout=PATIENCE) == [0.8]
    rig.wait(lambda: rig.state["gripper"] == "closed", "the gripper counts as closed")
    rig.press("upper")
    assert commands.get(timeout=PATIENCE) == [0.1]
    rig.wait(lambda: rig.state["gripper"] == "open", "the gripper counts as open")


def test_a_target_that_slips_on_its_leash_is_felt(rig: ArmRig, processes: Processes) -> None:
    rig.follows = False  # as if something were in the way
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
