"""Another project's controller moves the arms. In both modes, it gets targets that keep the rules of its preset.

This package's own controller stands in for it, with another name and topics. The left arm's node, in mode raw, sends it
the hand's target. The right arm's node, in mode filtered, sends it the built-in controller's safe target.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml

from q2r2_control import Robot
from q2r2_control.config.presets import BUILTIN, PRESETS
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError
from q2r2_control.supervision.reasons import SupervisionReason
from tests.ros.conftest import need_ros, spun_node
from tests.ros.processes import CONFIG, Processes

need_ros()
pytestmark = pytest.mark.alone

from geometry_msgs.msg import PoseStamped, WrenchStamped
from std_srvs.srv import SetBool

from q2r2_control.ros.base_node import COMMAND_QOS, LATCHED_QOS
from q2r2_control.ros.bridge.arm_outputs import CommandType
from q2r2_control.ros.bridge.joint_outputs import KINDS
from q2r2_control.ros.bridge.messages import pose_of, seconds
from tests.ros.arm_rig import ArmRig, ArmRigs, patient
from tests.ros.cell import PATIENT, Cell, start_controller, start_robot
from tests.ros.processes import wait_until

PRESET = "kuka_lbr_impedance"
STILL = 4e-3  # Largest motion of a tool at rest [m].
NEAR = 6e-3  # A tool within this distance has arrived [m].
SETTLED = 4e-3  # Largest distance between a target and a tool at the start of a stream [m].
LONGEST_GAP = 0.3  # Longest gap in a stream, on a machine with other load [s].
NAMES = {
    **dict.fromkeys(("builtin", "kuka_lbr_clik", "kuka_lbr_impedance", "fzi"), "target_frame"),
    **{"mayr": "reference_pose", "crisp": "target_pose", "moveit_servo": "pose_target_cmds"},
    **{"twist": "teleop_twist", "moveit_servo_twist": "delta_twist_cmds"},
    **{"forward_position": "commands", "jtc": "joint_trajectory"},
}
JOINTS = ("lbr_position", "lbr_torque", "forward_position", "jtc")


class Theirs:
    """The controller of both arms, which stands in for another project's controller, and all targets that it gets."""

    def __init__(self, node: Any, processes: Processes, robot: Robot) -> None:
        self._processes, self.robot = processes, robot
        # Targets with the tool's pose at the same time.
        self.targets: dict[str, list[tuple[PoseStamped, pin.SE3]]] = {arm: [] for arm in robot.arms}
        self.wrenches: list[WrenchStamped] = []
        self.cell = Cell(node, robot, targets="/not_used/{arm}")
        for arm in robot.arms:
            topic = f"/robot/{arm}_ctrl/target_frame"
            node.create_subscription(PoseStamped, topic, lambda m, arm=arm: self._take(arm, m), COMMAND_QOS)
        node.create_subscription(WrenchStamped, "/robot/left_ctrl/target_wrench", self.wrenches.append, LATCHED_QOS)
        self.start()

    def start(self) -> None:
        topics = [f"{arm}.target_topic:=/robot/{arm}_ctrl/target_frame" for arm in self.robot.arms]
        frames = [f"{arm}.target_frame_id:={arm}_link_0" for arm in self.robot.arms]
        self.process = start_controller(self._processes, *PATIENT, *topics, *frames, node="theirs")
        self.process.wait_for(SupervisionReason.ACTIVATED.template)

    def _take(self, arm: str, message: PoseStamped) -> None:
        self.targets[arm].append((message, self.cell.joints.tool(arm)))

    def assert_rules_kept(self) -> None:
        """Assert that all targets keep the preset's rules.

        They have unit quaternions in the arm's own frame. Streams begin at the tool, and move at the preset's speed.
        """
        fastest = PRESETS[PRESET].guard.max_velocity * 1.1
        for arm, targets in self.targets.items():
            assert len(targets) > 30, "on a slow computer not all of them are heard"
            base = self.robot.model.frames[self.robot.model.getFrameId(f"{arm}_link_0")].placement
            stream = [(seconds(message.header.stamp), base * pose_in(message), tool) for message, tool in targets]
            assert {message.header.frame_id for message, _ in targets} == {f"{arm}_link_0"}
            assert distance(stream[0][1], stream[0][2]) < SETTLED
            for (t, before, _), (now, target, tool) in pairwise(stream):
                gap = now - t
                at_the_tool = gap > LONGEST_GAP and distance(target, tool) < SETTLED
                assert at_the_tool or distance(before, target) < fastest * min(gap, LONGEST_GAP) + SETTLED, (arm, gap)


def pose_in(message: PoseStamped) -> pin.SE3:
    turned, pose = message.pose.orientation, pose_of(message.pose)
    assert abs(np.linalg.norm([turned.x, turned.y, turned.z, turned.w]) - 1.0) < 1e-6
    assert pose is not None
    return pose


def distance(one: pin.SE3, other: pin.SE3) -> float:
    return float(np.linalg.norm(one.translation - other.translation))


@pytest.fixture
def theirs(domain: int, robot: Robot, processes: Processes, tmp_path: Path) -> Iterator[Theirs]:
    """Return the cell with both controllers. The built-in controller has only the right arm and moves no arm itself."""
    cell = yaml.safe_load(find_resource(CONFIG).read_text())
    del cell["arms"]["left"]
    (right_arm := tmp_path / "right_arm.yaml").write_text(yaml.safe_dump(cell))
    with spun_node(domain) as node:
        start_robot(processes)
        theirs = Theirs(node, processes, robot)
        start_controller(processes, *PATIENT, "output:=none", "deviation_time:=2.0", config=str(right_arm))
        wait_until(lambda: theirs.cell.state("phase") == "active", "the built-in controller is active")
        yield theirs


def start_arm(node: Any, processes: Processes, arm: str, mode: str) -> ArmRig:
    rig = ArmRig(node, arm, topic="/unused/target_frame")
    rig.sends_tool = rig.follows = False
    prefix = f"/robot/{arm}_ctrl"
    given = {
        **{"preset": PRESET, "mode": mode, "ctrl_prefix": prefix, "controller_node": "/theirs"},
        **{"base_frame_id": f"{arm}_link_0", "world_frame_id": "world", "teleop.linked": False},
        **{"teleop.leash.distance": 0.0},  # 0 means: no leash. Targets then do not wait for a late arm.
    }
    processes.start_node(f"{arm}_arm_controller", *patient(given))
    return rig


def test_a_controller_gets_targets_that_keep_its_rules_in_both_modes(
    theirs: Theirs, processes: Processes, domain: int
) -> None:
    joints = theirs.cell.joints

    def move(by: tuple[float, float, float]) -> None:
        goals = {rig.arm: joints.tool(rig.arm).translation + np.array(by) for rig in rigs.rigs}
        rigs.move(by, 0.4)
        ways = lambda: [np.linalg.norm(joints.tool(arm).translation - goal) for arm, goal in goals.items()]  # noqa: E731
        wait_until(lambda: max(ways()) < NEAR, "the arms arrive", lambda: (ways(), [rig.state for rig in rigs.rigs]))
        joints.wait_for_rest()

    with spun_node(domain, "hands") as node:
        modes = {"left": "raw", "right": "filtered"}
        rigs = ArmRigs([start_arm(node, processes, arm, mode) for arm, mode in modes.items()])
        rigs.wait(lambda rig: rig.state.get("hand_age") is not None, "the arm's node receives the hand")
        with joints.tools_rest(STILL, "it is engaged"):
            rigs.wait_until_ready(3)
            rigs.engage()
        move((0.06, 0.0, 0.04))
        with joints.tools_rest(STILL, "it is paused and engaged again"):
            rigs.pause()
            rigs.move((-0.5, 0.2, 0.0), 0.05, turn=1.0)
            rigs.engage()
        with joints.tools_rest(STILL, "its hand data are lost and come back"):
            rigs.interrupt_hand_data()
            rigs.engage()
        move((0.0, 0.0, 0.06))
        os.kill(theirs.process.pid, signal.SIGKILL)
        theirs.process.wait()
        rigs.move((0.1, 0.0, 0.0), 0.3)  # The restarted controller must not get targets of this motion.
        rigs.wait_for_pause()
        joints.wait_for_rest()
        with joints.tools_rest(STILL, "its controller is restarted"):
            theirs.start()
            rigs.wait_until_ready(3)
            rigs.engage()
        move((-0.05, 0.0, 0.0))
    theirs.assert_rules_kept()
    wrench = theirs.wrenches[-1]
    assert wrench.header.frame_id == "left_link_0"
    assert (wrench.wrench.force.x, wrench.wrench.force.z, wrench.wrench.torque.x) == (0.0, 0.0, 0.0)


def test_moveit_servo_is_switched_to_poses_after_each_of_its_starts(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    service, module = "/servo/switch_command_type", "moveit_msgs.srv"
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match="moveit_msgs, which cannot be imported"):
        CommandType(node, service)
    # SetBool replaces the real service type, because moveit_msgs is not installed here; 2 stands for poses.
    asks = {"__init__": lambda self, command_type: SetBool.Request.__init__(self, data=command_type == 2)}
    request = type(SetBool.Request.__name__, (SetBool.Request,), {**asks, "__module__": SetBool.Request.__module__})
    kind = type("ServoCommandType", (SetBool,), {"Request": request})
    monkeypatch.setitem(sys.modules, module, SimpleNamespace(ServoCommandType=kind))
    command_type, asked = CommandType(node, service), []

    def agreed(starts: int) -> bool:
        command_type.step(starts, time.monotonic())
        return command_type.unready is None

    def answer(request: Any, response: Any) -> Any:
        asked.append(request.data)
        response.success = len(asked) > 1
        return response

    assert not agreed(0)  # There is no service yet.
    node.create_service(SetBool, service, answer)
    wait_until(lambda: agreed(0), "it agrees")
    assert asked == [True, True]  # The service refused the first request.
    assert agreed(0)
    assert not agreed(1)  # MoveIt Servo has started again.
    wait_until(lambda: agreed(1), "it agrees again")
    assert asked == [True, True, True]


@pytest.mark.parametrize("name", ["fzi", "mayr", "crisp", "kuka_lbr_clik"])
def test_each_untested_preset_differs_from_the_tested_preset_only_in_names_and_requests(name: str) -> None:
    preset, run = PRESETS[name], PRESETS[PRESET]
    assert (preset.hold, preset.guard, preset.takes_targets) == (run.hold, run.guard, run.takes_targets)
    assert preset.command_type is None


def test_the_presets_have_the_topics_of_their_controllers() -> None:
    # In lbr_fri_ros2_stack, the topic's name is relative to its controller's node, so it is in the robot's namespace.
    lbr = PRESETS["lbr_position"].topic_of
    assert lbr("/left/lbr_joint_position_command_controller") == "/left/command/lbr_joint_position_command"
    assert lbr("/lbr_joint_position_command_controller") == "/command/lbr_joint_position_command"
    assert lbr("/{arm}/lbr_joint_position_command_controller") == f"/{KINDS['lbr_position'].topic}"
    assert PRESETS.keys() == {*NAMES, "lbr_position", "lbr_torque"}
    assert {name for name, preset in PRESETS.items() if not preset.takes_targets} == set(JOINTS)
    for name, preset in PRESETS.items():
        if name in NAMES:
            assert preset.topic_of("/robot/left_ctrl") == f"/robot/left_ctrl/{NAMES[name]}"
        assert preset.rate >= preset.lowest_rate
        assert (preset.zero_wrench is not None) == (name == "kuka_lbr_impedance")
        assert (preset.command_type is not None) == (name in ("moveit_servo", "moveit_servo_twist"))
    assert PRESETS["builtin"] is BUILTIN
