"""Every preset on the simulated arms, moved by a strict controller that prints each rule which a target breaks.

The left arm's controller gets the hand's target itself, the right arm's what the built-in controller makes of it; all
are processes. What is asserted of the arms is asserted at every joint state.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import yaml

from q2r2_control import Robot
from q2r2_control.config.presets import BUILTIN, PRESETS, Mode, preset_of
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import CONFIG, PATIENCE, Processes, skip_if_overloaded

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = [pytest.mark.usefixtures("interfaces"), pytest.mark.alone]

from geometry_msgs.msg import PoseStamped  # noqa: E402

from q2r2_control.ros.bridge.messages import stamped_pose  # noqa: E402
from tests.ros.preset_bench import PresetBench, StrictControllers, arm_controllers, run_through  # noqa: E402
from tests.ros.programs.strict_controllers import Terms  # noqa: E402

POSES = {
    "builtin": Terms("target_frame", lowest_rate=20.0, fastest=3.3, fastest_turn=13.0),  # it has limits of its own
    "kuka_lbr_clik": Terms("target_frame"),
    "kuka_lbr_impedance": Terms("target_frame", lowest_rate=100.0, wrench=True),
    "fzi": Terms("target_frame"),
    "mayr": Terms("reference_pose"),
    "crisp": Terms("target_pose", frame="ignored"),
    "moveit_servo": Terms("pose_target_cmds", frame="any", lowest_rate=10.0, longest_age=0.1, command_type=True),
}
# Not run, since they are as another one but for their names.
ALIKE = {"fzi": "kuka_lbr_clik", "mayr": "kuka_lbr_clik"}
JOINTS = {
    "lbr_position": Terms("command/joint_position", message="lbr", lowest_rate=100.0),
    "forward_position": Terms("commands", message="array", lowest_rate=100.0),
    "jtc": Terms("joint_trajectory", message="trajectory", lowest_rate=20.0),
}


@pytest.fixture(scope="module")
def bench(domain: int, robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PresetBench]:
    folder = tmp_path_factory.mktemp("bench")
    running, right_arm = Processes(folder, os.environ), folder / "right_arm.yaml"
    cell = yaml.safe_load(find_resource(CONFIG).read_text())
    del cell["arms"]["left"]
    right_arm.write_text(yaml.safe_dump(cell))
    with spun_node(domain) as node:
        yield PresetBench(domain, node, robot, running, right_arm)
        running.end_all()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(POSES.keys() - ALIKE.keys()))
def test_targets_keep_the_rules_of_a_controller_in_both_modes_and_its_arm_moves_smoothly(
    name: str, bench: PresetBench, processes: Processes, other_interfaces: dict[str, str]
) -> None:
    bench.reset("output:=none")
    environment = other_interfaces if POSES[name].command_type else {}
    controllers = StrictControllers(processes, POSES[name], environment)
    controllers.start()
    modes = {"left": "raw", "right": "raw" if name == "builtin" else "filtered"}
    with arm_controllers(bench, processes, name, modes, environment) as rigs:
        run_through(bench, rigs, controllers, PRESETS[name].guard)
        stamps = [target.header.stamp.sec + 1e-9 * target.header.stamp.nanosec for target in rigs.rigs[0].targets]
    # Half of it, since other programs take their part; that the preset asks for enough is tested below.
    rate = 1.0 / np.median(np.diff(stamps))
    if rate <= 0.5 * POSES[name].lowest_rate:
        skip_if_overloaded(f"targets come at {rate:.0f} Hz")
    assert rate > 0.5 * POSES[name].lowest_rate


@pytest.mark.slow
@pytest.mark.parametrize("name", JOINTS)
def test_joint_commands_of_the_built_in_controller_keep_the_rules_of_a_controller_of_joints(
    name: str, bench: PresetBench, processes: Processes, other_interfaces: dict[str, str]
) -> None:
    terms, preset = JOINTS[name], PRESETS[name]
    topic = f"right.output_topic:=/robot/right_ctrl/{terms.topic}"
    environment = other_interfaces if terms.message == "lbr" else {}
    bench.reset(f"output:={preset.output}", topic, f"rate:={preset.rate}", **environment)
    controllers = StrictControllers(processes, terms, environment)
    controllers.start()
    with arm_controllers(bench, processes, name, {"right": "filtered"}, environment) as rigs:
        run_through(bench, rigs, controllers, BUILTIN.guard)


class Sender:
    """Sends poses to the left strict controller until it reports a broken rule."""

    def __init__(self, bench: PresetBench) -> None:
        self._node, self.tool = bench.node, bench.joints.tool("left")
        self._publisher = bench.node.create_publisher(PoseStamped, TOPIC, 1)

    def send_until(
        self, text: str, controllers: StrictControllers, by: float = 0.0, frame: str = "left_link_0", age: float = 0.0
    ) -> None:
        base = pin.SE3(np.eye(3), np.array([0.0, 0.4, 0.0]))  # of the left arm in the world
        pose = base.actInv(pin.SE3(self.tool.rotation, self.tool.translation + np.array([0.0, 0.0, by])))
        deadline = time.monotonic() + PATIENCE
        while not any(text in line for line in controllers.violations):
            assert time.monotonic() < deadline, text
            message = stamped_pose(pose, frame, 1e-9 * self._node.get_clock().now().nanoseconds - age)
            message.pose.orientation.w += 0.1 if "unit" in text else 0.0
            self._publisher.publish(message)
            time.sleep(0.02)

    def end(self) -> None:
        self._node.destroy_publisher(self._publisher)


TOPIC = "/robot/left_ctrl/target_frame"


@pytest.fixture
def sender(bench: PresetBench) -> Iterator[Sender]:
    bench.reset("output:=none")
    made = Sender(bench)
    yield made
    made.end()


def start_controllers(processes: Processes, terms: Terms, environment: dict[str, str]) -> StrictControllers:
    controllers = StrictControllers(processes, terms, environment)
    controllers.start()
    controllers.wait_until_ready()
    return controllers


def test_the_strict_controllers_notice_every_broken_rule(
    bench: PresetBench, sender: Sender, processes: Processes, other_interfaces: dict[str, str]
) -> None:
    waits = start_controllers(processes, Terms("target_frame", command_type=True), other_interfaces)
    sender.send_until("left: a pose before the switch to poses", waits)
    waits.kill()

    strict = start_controllers(processes, Terms("target_frame", longest_age=0.1, wrench=True), other_interfaces)
    sender.send_until("left: frame 'world'", strict, frame="world")
    sender.send_until("s old", strict, age=1.0)
    sender.send_until("no zero wrench", strict)
    sender.send_until("jump of 0.1", strict, by=0.1)
    sender.send_until("not a unit quaternion", strict)
    other = bench.node.create_publisher(PoseStamped, TOPIC, 1)
    sender.send_until("2 publishers", strict)
    bench.node.destroy_publisher(other)
    strict.kill()


def test_where_moveit_msgs_is_missing_the_user_is_told_to_switch_to_poses(
    bench: PresetBench, node: Any, processes: Processes
) -> None:
    node.create_subscription(PoseStamped, "/robot/left_ctrl/pose_target_cmds", lambda _: None, 1)
    with arm_controllers(bench, processes, "moveit_servo", {"left": "raw"}, {}) as rigs:
        text = "moveit_msgs cannot be imported: call /robot/left_ctrl/switch_command_type with 2 yourself"
        rigs.wait(lambda rig: rig.state.get("message") == text, "the user is informed")


@pytest.mark.parametrize("name", ALIKE)
def test_presets_that_are_not_run_differ_in_names_only_from_one_that_is(name: str) -> None:
    preset, other = PRESETS[name], PRESETS[ALIKE[name]]
    assert replace(preset, name=other.name, topic=other.topic, activation=other.activation) == other
    assert replace(POSES[name], topic=POSES[ALIKE[name]].topic) == POSES[ALIKE[name]]


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
