"""The README's command for ROS and the documented port of another robot work as they stand there."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot
from q2r2_control.types import Array
from tests.ros.conftest import need_ros
from tests.ros.processes import PATIENCE, ROOT, Processes

need_ros()
pytestmark = pytest.mark.alone

from q2r2_control.ros.base_node import LATCHED_QOS
from q2r2_control.ros.bridge.messages import pose_of
from tests.ros.arm_rig import TOOL, ArmRig, assert_same, first, offset, patient, stamped_transform
from tests.ros.joint_recorder import JointRecorder
from tests.ros.waiting import wait_until

MOVED = 0.05  # [rad]


def test_the_documented_subclass_teleoperates_its_arm_in_its_robots_frame(
    node: Any, processes: Processes, tmp_path: Path
) -> None:
    from tf2_msgs.msg import TFMessage
    from visualization_msgs.msg import Marker

    base = pin.SE3(pin.exp3(np.array([0.0, 0.0, 1.2])), np.array([0.1, -0.4, 0.3]))
    static = node.create_publisher(TFMessage, "/tf_static", LATCHED_QOS)
    static.publish(TFMessage(transforms=[stamped_transform("world", "bh_robot_base", base)]))
    shown: dict[str, Any] = {}
    node.create_subscription(Marker, "/visualization_marker", lambda marker: shown.update({marker.ns: marker}), 10)

    topic = "/bh_robot/right_arm_clik_controller/target_frame"
    rig = ArmRig(node, "right", topic=topic, tool_frame="right_arm_link_ee", robot="bh_robot")
    rig.follows = False
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "ros.md").read_text(), re.DOTALL)
    (file := tmp_path / "right_arm.py").write_text(code)
    given = patient({"world_frame_id": "world", "teleop.leash.distance": 0.0})
    arguments = [part for parameter in given for part in ("-p", parameter)]
    process = processes.start(sys.executable, str(file), "--ros-args", *arguments, name="right_arm")
    rig.wait_until_connected()
    rig.engage()
    rig.wait(lambda: rig.targets, "targets come")
    assert rig.state["preset"] == "kuka_lbr_clik", "not the terms of another controller"
    assert rig.targets[0].header.frame_id == "bh_robot_base"
    assert_same(base * first(rig), TOOL, 1e-9)
    rig.move((0.0, 0.1, 0.0))
    assert_same(base * rig.wait_for_rest(), offset(TOOL, (0.0, 0.1, 0.0)), 1e-3)

    rig.wait(lambda: {"right_engaged", "right_axes", "right_path"} <= shown.keys(), "markers come")
    assert shown["right_axes"].header.frame_id == "right_arm_link_ee"
    assert_same(TOOL * (pose_of(shown["right_axes"].pose) or pin.SE3.Identity()), offset(TOOL, (0.0, 0.1, 0.0)), 2e-3)
    rig.pause()
    rig.wait(lambda: shown["right_engaged"].color.a < 1.0, "the marker fades")
    assert_same(pose_of(shown["right_engaged"].pose), pin.SE3.Identity(), 1e-9)
    assert process.interrupt(PATIENCE) == 0


@pytest.mark.slow
def test_the_command_in_the_readme_moves_both_arms(node: Any, robot: Robot, processes: Processes) -> None:
    command = re.search(r"`q2r2 (ros up \S+ --input scripted)`", (ROOT / "README.md").read_text())
    assert command is not None
    joints = JointRecorder(robot)
    joints.subscribe(node)
    up = processes.start(sys.executable, "-u", "-m", "q2r2_control", *command[1].split(), name="up")
    wait_until(lambda: all(farthest(joints, arm.joints) > MOVED for arm in robot.arms.values()), "both arms move")
    assert up.interrupt(PATIENCE) == 0


def farthest(recorder: JointRecorder, joints: Array) -> float:
    """How far some of the joints have been from where they were first [rad]."""
    states = recorder.states
    return float(np.abs(states[-1].q - states[0].q)[joints].max()) if states else 0.0
