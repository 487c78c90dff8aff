"""Every preset on the simulated arms, moved by a stand-in of its controller that prints each rule a target breaks.

The left arm's controller gets the hand's target itself, the right one's what the built-in controller makes of it; all
are processes. What is asserted of the arms is asserted at every joint state.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml

from q2r2_control import Robot, load_config
from q2r2_control.config.presets import BUILTIN, PRESETS, Mode, preset_of
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import PATIENCE, Processes

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = pytest.mark.usefixtures("interfaces")

from geometry_msgs.msg import PoseStamped  # noqa: E402

from q2r2_control.ros.bridge.messages import stamped_pose  # noqa: E402
from tests.ros.cell import CONFIG  # noqa: E402
from tests.ros.stage import Stage, StandIn, act, arms  # noqa: E402
from tests.ros.stand_in import Terms  # noqa: E402

POSES = {
    "builtin": Terms("target_frame", lowest_rate=20.0, fastest=3.3, fastest_turn=13.0),  # it has limits of its own
    "kuka_lbr_clik": Terms("target_frame"),
    "kuka_lbr_impedance": Terms("target_frame", lowest_rate=100.0, wrench=True),
    "fzi": Terms("target_frame"),
    "mayr": Terms("reference_pose"),
    "crisp": Terms("target_pose", frame="ignored"),
    "moveit_servo": Terms("pose_target_cmds", frame="any", lowest_rate=10.0, longest_age=0.1, command_type=True),
}
JOINTS = {
    "lbr_position": Terms("command/joint_position", message="lbr", lowest_rate=100.0),
    "forward_position": Terms("commands", message="array", lowest_rate=100.0),
    "jtc": Terms("joint_trajectory", message="trajectory", lowest_rate=20.0),
}


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config(CONFIG))


@pytest.fixture(scope="module")
def stage(domain: int, robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    folder = tmp_path_factory.mktemp("stage")
    running, right_arm = Processes(folder, os.environ), folder / "right_arm.yaml"
    cell = yaml.safe_load(find_resource(CONFIG).read_text())
    del cell["arms"]["left"]
    right_arm.write_text(yaml.safe_dump(cell))
    with spun_node(domain) as node:
        yield Stage(domain, node, robot, running, right_arm)
        running.end_all()


@pytest.mark.parametrize("name", POSES)
def test_a_controllers_rules_hold_and_its_arm_moves_smoothly_with_and_without_the_built_in_one_between(
    name: str, stage: Stage, processes: Processes, others: dict[str, str]
) -> None:
    stage.set("output:=none")
    stand_in = StandIn(processes, POSES[name], others)
    stand_in.start()
    modes = {"left": "raw", "right": "raw" if name == "builtin" else "filtered"}
    with arms(stage, processes, name, modes, others) as hands:
        act(stage, hands, stand_in, PRESETS[name].guard)
        stamps = [target.header.stamp.sec + 1e-9 * target.header.stamp.nanosec for target in hands.rigs[0].targets]
    # Half of it, since a busy machine may not have the time; that the node asks for enough is tested below.
    assert 1.0 / np.median(np.diff(stamps)) > 0.5 * POSES[name].lowest_rate


@pytest.mark.parametrize("name", JOINTS)
def test_a_controller_of_joints_is_led_by_the_built_in_one_within_its_rules(
    name: str, stage: Stage, processes: Processes, others: dict[str, str]
) -> None:
    terms, preset = JOINTS[name], PRESETS[name]
    topic = f"right.output_topic:=/robot/right_ctrl/{terms.topic}"
    stage.set(f"output:={preset.output}", topic, f"rate:={preset.rate}", **others)
    stand_in = StandIn(processes, terms, others)
    stand_in.start()
    with arms(stage, processes, name, {"right": "filtered"}, others) as hands:
        act(stage, hands, stand_in, BUILTIN.guard)


class Sender:
    """Sends the left stand-in poses until it complains."""

    def __init__(self, stage: Stage) -> None:
        self._node, self.tool = stage.node, stage.motion.tool("left")
        self._publisher = stage.node.create_publisher(PoseStamped, TOPIC, 1)

    def send_until(
        self, text: str, stand_in: StandIn, by: float = 0.0, frame: str = "left_link_0", age: float = 0.0
    ) -> None:
        base = pin.SE3(np.eye(3), np.array([0.0, 0.4, 0.0]))  # of the left arm in the world
        pose = base.actInv(pin.SE3(self.tool.rotation, self.tool.translation + np.array([0.0, 0.0, by])))
        deadline = time.monotonic() + PATIENCE
        while not any(text in line for line in stand_in.violations):
            assert time.monotonic() < deadline, text
            message = stamped_pose(pose, frame, 1e-9 * self._node.get_clock().now().nanoseconds - age)
            message.pose.orientation.w += 0.1 if "unit" in text else 0.0
            self._publisher.publish(message)
            time.sleep(0.02)

    def end(self) -> None:
        self._node.destroy_publisher(self._publisher)


TOPIC = "/robot/left_ctrl/target_frame"


@pytest.fixture
def sender(stage: Stage) -> Iterator[Sender]:
    stage.set("output:=none")
    made = Sender(stage)
    yield made
    made.end()


def stood_in(processes: Processes, terms: Terms, environment: dict[str, str]) -> StandIn:
    stand_in = StandIn(processes, terms, environment)
    stand_in.start()
    stand_in.wait_until_ready()
    return stand_in


def test_the_stand_in_notices_what_it_is_there_to_notice(
    stage: Stage, sender: Sender, processes: Processes, others: dict[str, str]
) -> None:
    waits = stood_in(processes, Terms("target_frame", command_type=True), others)
    sender.send_until("left: a pose before the switch to poses", waits)
    waits.kill()

    strict = stood_in(processes, Terms("target_frame", longest_age=0.1, wrench=True), others)
    sender.send_until("left: frame 'world'", strict, frame="world")
    sender.send_until("s old", strict, age=1.0)
    sender.send_until("no zero wrench", strict)
    sender.send_until("jump of 0.1", strict, by=0.1)
    sender.send_until("not a unit quaternion", strict)
    other = stage.node.create_publisher(PoseStamped, TOPIC, 1)
    sender.send_until("2 publishers", strict)
    stage.node.destroy_publisher(other)
    strict.kill()


def test_where_moveit_msgs_is_missing_the_user_is_told_to_switch_to_poses(
    stage: Stage, node: Any, processes: Processes
) -> None:
    node.create_subscription(PoseStamped, "/robot/left_ctrl/pose_target_cmds", lambda _: None, 1)
    with arms(stage, processes, "moveit_servo", {"left": "raw"}, {}) as hands:
        text = "moveit_msgs cannot be imported: call /robot/left_ctrl/switch_command_type with 2 yourself"
        hands.wait(lambda rig: rig.state.get("message") == text, "the user is told")


def test_the_presets_are_those_whose_rules_are_tested() -> None:
    assert PRESETS.keys() == POSES.keys() | JOINTS.keys()
    assert {name for name, preset in PRESETS.items() if not preset.takes_poses} == JOINTS.keys()
    for name, terms in (POSES | JOINTS).items():
        preset = PRESETS[name]
        assert preset.topic.format(ctrl="/robot/left_ctrl") == f"/robot/left_ctrl/{terms.topic}"
        assert preset.rate >= preset.lowest_rate >= terms.lowest_rate
        assert (preset.zero_wrench is not None, preset.command_type is not None) == (terms.wrench, terms.command_type)


@pytest.mark.parametrize("name", JOINTS)
def test_presets_that_take_joints_need_the_built_in_controller(name: str) -> None:
    assert preset_of(name, "filtered") == (PRESETS[name], Mode.FILTERED)
    with pytest.raises(ConfigError, match=f"preset = '{name}' with mode = 'raw': it takes joint positions"):
        preset_of(name, "raw")
