"""Every preset on the simulated arms, moved by a strict controller that prints each rule which a target breaks.

The left arm's controller gets the hand's target itself, the right arm's what the built-in controller makes of it; all
are processes. What is asserted of the arms is asserted at every joint state.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import yaml

from q2r2_control import Robot
from q2r2_control.config.presets import BUILTIN, PRESETS, Mode, preset_of
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import CONFIG, Processes

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = [pytest.mark.usefixtures("interfaces"), pytest.mark.alone]

from geometry_msgs.msg import PoseStamped  # noqa: E402

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
RUN = ("builtin", "kuka_lbr_impedance", "moveit_servo")  # the others ask for less, or have other names
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


# By its own command: about every third run the arm is lost in the tick that engages it in mode filtered, since the safe
# target is not where the tool is. The cause is not known yet.
@pytest.mark.soak
@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
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


@pytest.mark.parametrize("name", ["lbr_position", "forward_position"])
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


def test_where_moveit_msgs_is_missing_the_user_is_told_to_switch_to_poses(
    bench: PresetBench, node: Any, processes: Processes
) -> None:
    node.create_subscription(PoseStamped, "/robot/left_ctrl/pose_target_cmds", lambda _: None, 1)
    with arm_controllers(bench, processes, "moveit_servo", {"left": "raw"}, {}) as rigs:
        text = "moveit_msgs cannot be imported: call /robot/left_ctrl/switch_command_type with 2 yourself"
        rigs.wait(lambda rig: rig.state.get("message") == text, "the user is informed")


@pytest.mark.parametrize("name", ["fzi", "mayr", "crisp"])
def test_a_preset_that_is_not_run_differs_from_one_that_is_in_names_and_what_it_asks_for(name: str) -> None:
    preset, other = PRESETS[name], PRESETS["kuka_lbr_clik"]
    alike = replace(preset, name=other.name, topic=other.topic, activation=other.activation)
    assert alike == other
    impedance = PRESETS["kuka_lbr_impedance"]
    assert (other.hold, other.guard) == (impedance.hold, impedance.guard)


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
