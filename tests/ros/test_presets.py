"""Every preset against a stand-in of its controller that prints each rule a target breaks; real processes."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.errors import ConfigError
from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import PATIENCE, Processes, RosProcess

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = pytest.mark.usefixtures("interfaces")

from q2r2_control.teleop.presets import PRESETS, Mode, preset_of  # noqa: E402
from tests.ros.arm_rig import ArmRig  # noqa: E402

CONTROLLER = "/robot/left_ctrl"


class Terms(NamedTuple):
    """What a controller's own documentation asks for."""

    topic: str
    frame: str = "robot_base"  # "": takes any
    lowest_rate: float = 50.0  # [Hz]
    longest_age: float = 0.5  # [s]; not a rule where it is longer than 0.1, then only a bound on our own delay
    wrench: str = ""


CARTESIAN = {
    "builtin": Terms("target_frame", lowest_rate=20.0),
    "kuka_lbr_clik": Terms("target_frame"),
    "kuka_lbr_impedance": Terms("target_frame", lowest_rate=100.0, wrench=f"{CONTROLLER}/target_wrench"),
    "fzi": Terms("target_frame"),
    "mayr": Terms("reference_pose"),
    "crisp": Terms("target_pose", frame=""),
    "moveit_servo": Terms("pose_target_cmds", frame="", lowest_rate=10.0, longest_age=0.1),
}
JOINTS = {"lbr_position", "forward_position", "jtc"}


class Robot:
    """The stand-in and where its tool is, seen from outside."""

    def __init__(self, node: Any, processes: Processes, terms: Terms) -> None:
        from tf2_msgs.msg import TFMessage

        self._processes, self._terms = processes, terms
        self.tools: list[Any] = []
        self.lives: list[RosProcess] = []
        node.create_subscription(TFMessage, "/tf", self._on_tf, 100)

    def start(self, position: Any = (0.5, 0.25, 0.38)) -> None:
        terms = self._terms
        options = [f"--topic={CONTROLLER}/{terms.topic}", f"--frame={terms.frame}", f"--wrench={terms.wrench}"]
        options += [f"--longest-age={terms.longest_age}", "--position", *map(str, position)]
        self.lives.append(self._processes.start_module("tests.ros.stand_in", *options))
        self.lives[-1].wait_for("ready")

    def wait_until_driven(self) -> None:
        """Return once the first target has arrived: one that a busy machine loses is not this test's subject."""
        self.lives[-1].wait_for("first target")

    def kill(self) -> None:
        os.kill(self.lives[-1].pid, signal.SIGKILL)
        self.lives[-1].wait()

    @property
    def violations(self) -> list[str]:
        return [line for life in self.lives for line in life.output.splitlines() if line.startswith("violation")]

    def _on_tf(self, message: Any) -> None:
        at = message.transforms[0].transform.translation
        self.tools.append(np.array([at.x, at.y, at.z]))


@pytest.mark.parametrize("name", CARTESIAN)
def test_a_controllers_rules_hold_through_pause_loss_of_input_and_restart(
    name: str, node: Any, processes: Processes
) -> None:
    terms = CARTESIAN[name]
    robot = Robot(node, processes, terms)
    rig = ArmRig(node, topic=f"{CONTROLLER}/{terms.topic}")
    rig.tells_tool = False
    robot.start()
    names = {"preset": name, "ctrl_prefix": CONTROLLER, "base_frame_id": "robot_base"}
    rig.start(processes, names | {"teleop.gate.timeout": 0.4, "tool_timeout": 0.4})
    rig.engage()
    robot.wait_until_driven()
    rig.move((0.06, 0.0, 0.03), 0.3, turn=0.2)
    stamps = [target.header.stamp.sec + 1e-9 * target.header.stamp.nanosec for target in rig.targets]
    # Half of it, since a busy machine may not have the time; that the node asks for enough is tested below.
    assert 1.0 / np.median(np.diff(stamps)) > 0.5 * terms.lowest_rate
    rig.pause()
    rig.move((-0.5, 0.2, 0.0), 0.05, turn=1.0)
    rig.engage()
    rig.move((0.0, 0.06, 0.0), 0.2)
    rig.sends_hand = False
    rig.wait(lambda: rig.state["state"] == "paused", "the loss of the hand pauses the arm")
    rig.hand = pin.SE3(rig.hand.rotation, rig.hand.translation + 0.4)
    rig.sends_hand = True
    rig.engage()

    rig.move((0.0, 0.0, 0.08), 0.2)
    robot.kill()
    rig.wait(lambda: rig.state["state"] == "paused", "a robot that is gone pauses the arm")
    elsewhere = robot.tools[-1] + [0.0, 0.05, -0.03]
    robot.start(elsewhere)
    rig.wait(lambda: np.allclose(robot.tools[-1], elsewhere), "the robot is back")
    sent, rig.state = len(rig.targets), {}
    rig.wait(lambda: rig.state.get("level") == "ok", "the controller is back")
    time.sleep(0.2)
    assert len(rig.targets) == sent
    np.testing.assert_allclose(robot.tools[-1], elsewhere, atol=1e-9)
    rig.engage()
    robot.wait_until_driven()
    rig.move((0.05, 0.0, 0.0), 0.2)
    rig.wait(lambda: robot.tools[-1][0] - elsewhere[0] > 0.045, "the arm follows again")
    assert robot.violations == []


def test_the_stand_in_notices_what_it_is_there_to_notice(node: Any, processes: Processes) -> None:
    from geometry_msgs.msg import PoseStamped

    topic = f"{CONTROLLER}/target_frame"
    robot = Robot(node, processes, Terms("target_frame", longest_age=0.1))
    robot.start()
    publisher = node.create_publisher(PoseStamped, topic, 1)
    message = PoseStamped()
    message.header.frame_id = "robot_base"
    message.pose.position.x, message.pose.position.y, message.pose.position.z = 0.5, 0.25, 0.38
    message.pose.orientation.y, message.pose.orientation.w = 1.0, 0.0

    def send_until(text: str, age: float = 0.0) -> None:
        deadline = time.monotonic() + PATIENCE
        while not any(text in line for line in robot.violations):
            assert time.monotonic() < deadline, text
            message.header.stamp = node.get_clock().now().to_msg()
            message.header.stamp.sec -= int(age)
            publisher.publish(message)
            time.sleep(0.02)

    message.header.frame_id = "world"
    send_until("frame 'world'")
    message.header.frame_id = "robot_base"
    send_until("s old", age=1.0)
    message.pose.position.x = 0.9
    send_until("jump of 0.4")
    message.pose.orientation.y = 0.9
    send_until("not a unit quaternion")
    other = node.create_publisher(PoseStamped, topic, 1)
    send_until("2 publishers")
    node.destroy_publisher(other)


@pytest.fixture
def safe_targets(node: Any) -> Iterator[list[Any]]:
    """Plays the built-in controller: allows every target, once there is one in the list."""
    from geometry_msgs.msg import PoseStamped

    allowed: list[Any] = []
    publisher = node.create_publisher(PoseStamped, "/cartesian_controller/safe_target/left", 1)
    timer = node.create_timer(0.01, lambda: allowed and publisher.publish(allowed[-1]))
    yield allowed
    node.destroy_timer(timer)


def test_in_mode_filtered_the_external_controller_gets_what_the_built_in_one_allows(
    node: Any, processes: Processes, safe_targets: list[Any]
) -> None:
    from q2r2_control.ros.messages import stamped_pose

    robot = Robot(node, processes, CARTESIAN["fzi"])
    rig = ArmRig(node)
    rig.tells_tool = False
    robot.start()
    names = {"preset": "fzi", "mode": "filtered", "ctrl_prefix": CONTROLLER, "base_frame_id": "robot_base"}
    rig.start(processes, names)
    rig.wait(lambda: rig.state.get("level") == "ok", "all is there")
    rig.press()
    rig.wait(lambda: "nothing on /cartesian_controller" in rig.state["last_event"], "no safe target, no motion")
    start = pin.SE3(np.diag([-1.0, 1.0, -1.0]), np.array([0.5, 0.25, 0.38]))
    rig.targets = safe_targets
    safe_targets.append(stamped_pose(start, "robot_base", 0.0))
    time.sleep(0.1)
    rig.engage()
    rig.move((0.08, 0.0, 0.0), 0.3)
    rig.wait(lambda: robot.tools[-1][0] > 0.575, "the arm follows what is allowed")
    assert robot.violations == []


def test_the_presets_are_those_whose_rules_are_tested_and_those_that_take_joints() -> None:
    assert PRESETS.keys() == CARTESIAN.keys() | JOINTS
    assert {name for name, preset in PRESETS.items() if not preset.takes_poses} == JOINTS
    for name, terms in CARTESIAN.items():
        preset = PRESETS[name]
        assert preset.topic.format(ctrl=CONTROLLER) == f"{CONTROLLER}/{terms.topic}"
        assert preset.rate >= preset.lowest_rate >= terms.lowest_rate


@pytest.mark.parametrize("name", sorted(JOINTS))
def test_presets_that_take_joints_need_the_built_in_controller(name: str) -> None:
    assert preset_of(name, "filtered") == (PRESETS[name], Mode.FILTERED)
    with pytest.raises(ConfigError, match=f"preset = '{name}' with mode = 'raw': it takes joint positions"):
        preset_of(name, "raw")
