"""Two arms' nodes that carry together: one hand moves both tools, and whatever ends it ends it for both."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import PATIENCE, Processes, RosProcess

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = pytest.mark.usefixtures("interfaces")

from geometry_msgs.msg import PoseStamped  # noqa: E402
from std_msgs.msg import Float64MultiArray, String  # noqa: E402

from q2r2_control.recording.ros_topics import arm_flags, asked_target  # noqa: E402
from q2r2_control.ros.base_node import COMMAND_QOS, RECORDED_QOS  # noqa: E402
from q2r2_control.ros.bridge.messages import nanoseconds, pose_numbers, pose_of, pose_of_numbers  # noqa: E402
from q2r2_control.ros.monitoring.arm_link import ArmLink, CarryTold  # noqa: E402
from q2r2_control.types import SIDES, Array  # noqa: E402
from tests.ros.arm_rig import TOOL, ArmRig, ArmRigs, assert_same, offset  # noqa: E402
from tests.ros.cockpit import Cockpit  # noqa: E402
from tests.ros.waiting import call, wait_until  # noqa: E402

BINDINGS = {"teleop.bindings.grip": "carry"}
TOOLS = {"left": TOOL, "right": offset(TOOL, (0.0, -0.5, 0.05), 0.3)}
STATES = {"left": "engaged", "right": "carried"}


def begin(left: ArmRig, rigs: ArmRigs) -> None:
    """The left hand carries; it asks again where it was refused, as while the nodes get to know each other."""
    deadline = time.monotonic() + PATIENCE
    while any(rig.state["state"] != STATES[rig.arm] for rig in rigs.rigs):
        assert time.monotonic() < deadline, [rig.state for rig in rigs.rigs]
        left.grip = 1.0
        time.sleep(0.3)
        left.grip = 0.0
        left.wait(lambda: "carr" in left.state["last_event"], "an answer comes")
        time.sleep(0.3)


class Pair:
    """Two hands, and two arms that are where their nodes ask them to be."""

    def __init__(self, node: Any, processes: Processes) -> None:
        self.left, self.right = ArmRig(node, "left"), ArmRig(node, "right")
        self.rigs = ArmRigs([self.left, self.right])
        self.nodes: dict[str, RosProcess] = {}
        for rig in self.rigs.rigs:
            rig.tool = TOOLS[rig.arm]
            self.nodes[rig.arm] = rig.start(processes, BINDINGS)

    def carry(self, *engaged: ArmRig) -> None:
        ArmRigs(list(engaged or self.rigs.rigs)).engage()
        begin(self.left, self.rigs)
        self.left.move((0.05, 0.0, 0.0), 0.3)

    def wait_for_states(self, *allowed: str) -> None:
        self.rigs.wait(lambda rig: rig.state["state"] in allowed, f"the arms are {' or '.join(allowed)}")

    def assert_nothing_moves(self, *rigs: ArmRig) -> None:
        rest = [rig.wait_for_rest() for rig in rigs]
        self.left.move((0.1, 0.1, 0.0), 0.3, 0.3)
        for rig, pose in zip(rigs, rest, strict=True):
            assert_same(rig.newest(), pose, 1e-9)


@pytest.fixture
def pair(domain: int, processes: Processes) -> Iterator[Pair]:
    with spun_node(domain) as node:
        yield Pair(node, processes)


def test_one_hand_moves_both_tools_whose_targets_of_one_tick_keep_their_relation(pair: Pair) -> None:
    sent: dict[int, pin.SE3] = {}
    led: dict[int, pin.SE3] = {}

    def take_sent(message: String) -> None:
        pose = json.loads(message.data)
        sent[pose["stamp"]] = pose_of_numbers(pose["pose"])

    def take_led(message: PoseStamped) -> None:
        led[nanoseconds(message.header.stamp)] = pose_of(message.pose)

    node = pair.left.node
    node.create_subscription(String, "/q2r2/left/carry", take_sent, RECORDED_QOS)
    node.create_subscription(PoseStamped, asked_target("left"), take_led, RECORDED_QOS)
    node.create_subscription(Float64MultiArray, arm_flags("left"), lambda _: None, RECORDED_QOS)
    pair.rigs.engage()
    begin(pair.left, pair.rigs)
    start = {rig.arm: rig.wait_for_rest() for rig in pair.rigs.rigs}
    for arm, pose in start.items():
        assert_same(pose, TOOLS[arm], 1e-6)  # it began without a motion
    pair.left.move((0.1, 0.05, 0.05), 1.0, 0.3)
    pair.right.move((-0.2, 0.0, 0.0), 0.3)  # whose hand moves nothing
    ends = {rig.arm: rig.wait_for_rest() for rig in pair.rigs.rigs}
    wanted = start["left"].actInv(start["right"])
    pair.left.wait(lambda: pair.left.state["sent"]["/q2r2/left/carry"] >= len(sent) > 20, "the node counts them")
    both = sent.keys() & led.keys()
    assert len(both) > 20
    for stamp in both:
        assert_same(led[stamp].actInv(sent[stamp]), wanted, 1e-6)
    assert_same(ends["left"].actInv(ends["right"]), wanted, 1e-6)
    middle = np.mean([ends[arm].translation - start[arm].translation for arm in SIDES], axis=0)
    np.testing.assert_allclose(middle, (0.1, 0.05, 0.05), atol=1e-3)
    np.testing.assert_allclose(pin.log3(ends["right"].rotation @ start["right"].rotation.T), (0, 0, 0.3), atol=2e-3)


def test_the_arm_that_is_carried_needs_no_hand_and_no_press(pair: Pair) -> None:
    pair.right.sends_hand = False
    pair.right.wait(lambda: "no data of the right hand" in pair.right.state["message"], "the hand is put down")
    pair.carry(pair.left)
    time.sleep(1.5)  # longer than the hand's timeout
    assert pair.right.state["state"] == "carried"
    assert_same(pair.right.wait_for_rest(), offset(TOOLS["right"], (0.05, 0.0, 0.0)), 1e-3)


@pytest.mark.parametrize("hand", SIDES)
def test_a_press_of_either_hand_pauses_both(pair: Pair, hand: str) -> None:
    pair.carry()
    rig = pair.left if hand == "left" else pair.right
    if hand == "left":
        rig.grip = 1.0
    else:
        rig.press()
    pair.wait_for_states("paused")
    pair.left.grip = 0.0
    pair.assert_nothing_moves(*pair.rigs.rigs)
    pair.rigs.engage()
    assert pair.left.state["state"] == pair.right.state["state"] == "engaged"


@pytest.mark.parametrize("killed", SIDES)
def test_a_node_that_is_killed_stops_the_other_arm_and_its_restart_moves_nothing(
    pair: Pair, processes: Processes, killed: str
) -> None:
    pair.carry()
    gone, left_over = (pair.left, pair.right) if killed == "left" else (pair.right, pair.left)
    os.kill(pair.nodes[killed].pid, signal.SIGKILL)
    pair.nodes[killed].wait()
    left_over.wait(lambda: left_over.state["state"] == "lost", "the other arm is stopped")
    # The heartbeats and the poses that are carried end together, and either is missed first.
    reasons = f"/{killed}_q2r2_arm_controller is silent", f"no pose from the {killed} arm's node"
    assert any(reason in left_over.state["last_event"] for reason in reasons)
    pair.assert_nothing_moves(left_over)
    gone.state = {}
    gone.start(processes, BINDINGS)
    pair.assert_nothing_moves(gone, left_over)
    assert (gone.state["state"], left_over.state["state"]) == ("idle", "lost")


def test_a_second_sender_of_its_targets_stops_both(pair: Pair) -> None:
    pair.carry()
    pair.left.node.create_publisher(String, "/q2r2/left/carry", COMMAND_QOS)
    pair.wait_for_states("lost", "paused")
    assert "2 publishers of /q2r2/left/carry, allowed is one" in pair.right.state["last_event"]
    pair.assert_nothing_moves(*pair.rigs.rigs)


class Leader:
    """Speaks for the left arm's node."""

    def __init__(self, node: Any) -> None:
        self.link = ArmLink(node, "q2r2", "left", "side_by_side", 3.0)
        self.pose: pin.SE3 | None = None
        self.began = node.get_clock().now().nanoseconds
        self._node = node
        self._publisher = node.create_publisher(String, "/q2r2/left/carry", COMMAND_QOS)
        node.create_timer(0.01, self._send)

    def ask(self) -> pin.SE3:
        """Where the right arm agrees to hold its tool."""
        wait_until(lambda: self.link.other_run, "the right arm's node is there")
        self.link.say_carry(CarryTold(session="it 1", to=str(self.link.other_run), leads=True, frame="world"))
        wait_until(lambda: self.link.carry is not None and self.link.carry.tool, "it agrees", lambda: self.link.carry)
        told = self.link.carry
        assert told is not None
        assert told.tool is not None
        self.pose = pose_of_numbers(told.tool)
        assert self.pose is not None
        return self.pose

    def text(self, target: pin.SE3, **changes: Any) -> str:
        """A target of now."""
        stamp = self._node.get_clock().now().nanoseconds
        values = {"session": "it 1", "stamp": stamp, "frame": "world", "pose": pose_numbers(target)}
        return json.dumps(values | changes)

    def send(self, text: str) -> None:
        self._publisher.publish(String(data=text))

    def _send(self) -> None:
        if self.pose is not None:
            self.send(self.text(self.pose))


Hostile = Callable[[Leader, pin.SE3], str]
HOSTILE: dict[str, Hostile] = {
    "no pose at all": lambda leader, near: '{"session": "it 1"}',
    "not a number": lambda leader, near: leader.text(near).replace("[0.5", "[NaN"),
    "no rotation": lambda leader, near: leader.text(near, pose=(*near.translation.tolist(), 0.0, 0.0, 0.0, 2.0)),
    "a jump": lambda leader, near: leader.text(offset(near, (0.0, 0.0, 0.2))),
    "a turn": lambda leader, near: leader.text(offset(near, (0.0, 0.0, 0.0), 0.5)),
    "of another session": lambda leader, near: leader.text(near, session="it 2"),
    "in another frame": lambda leader, near: leader.text(near, frame="base"),
    "older than the last": lambda leader, near: leader.text(near, stamp=leader.began),
    # When the leader has been silent for longer, this is newer than its last one.
    "long under way": lambda leader, near: leader.text(near, stamp=time.time_ns() - 400_000_000),
}


def test_targets_that_no_honest_leader_sends_do_not_move_the_arm_and_alone_stop_it(
    node: Any, processes: Processes
) -> None:
    right, leader = ArmRig(node, "right"), Leader(node)
    right.tool = TOOLS["right"]
    right.start(processes, BINDINGS)
    held = leader.ask()
    assert_same(held, TOOLS["right"], 1e-9)
    leader.pose = offset(held, (0.0, 0.01, 0.0))
    right.wait(lambda: right.targets and right.newest().isApprox(leader.pose, 1e-6), "it believes its leader")
    right.wait_for_rest()
    begun, near = len(right.targets), offset(leader.pose, (0.02, 0.0, 0.0))
    for text in HOSTILE.values():
        for _ in range(10):
            leader.send(text(leader, near))
            time.sleep(0.005)
    assert right.state["state"] == "carried"
    leader_pose, leader.pose = leader.pose, None
    deadline = time.monotonic() + PATIENCE
    while right.state["state"] == "carried" and time.monotonic() < deadline:
        for text in HOSTILE.values():
            leader.send(text(leader, near))
            time.sleep(0.002)
    right.wait(lambda: right.state["state"] == "lost", "it stops")
    assert "no pose from the left arm's node for 3." in right.state["last_event"]
    for message in right.targets[begun:]:
        assert_same(pose_of(message.pose), leader_pose, 1e-6)


def test_nodes_whose_worlds_differ_do_not_carry(node: Any, processes: Processes) -> None:
    left, right = ArmRig(node, "left"), ArmRig(node, "right")
    left.start(processes, BINDINGS)
    right.start(processes, BINDINGS | {"world_frame_id": "base", "base_frame_id": "base"})
    left.engage()
    deadline = time.monotonic() + PATIENCE
    reason = "world_frame_id is 'base' of the right arm and 'world' of the left one: set both alike"
    while left.state["last_event"] != f"engaged: not carried: {reason}":
        assert time.monotonic() < deadline, left.state
        left.grip = 1.0 - left.grip
        time.sleep(0.3)
    assert right.state["state"] == "idle"


@pytest.mark.slow
@pytest.mark.alone
def test_simulated_tools_keep_their_relation(domain: int, robot: Robot, processes: Processes) -> None:
    with spun_node(domain) as node:
        cockpit = Cockpit(node, robot, processes, BINDINGS)
        cockpit.rigs.engage()
        begin(cockpit.left, cockpit.rigs)
        start = cockpit.cell.joints.wait_for_rest()
        cockpit.cell.forget()
        cockpit.left.move((0.06, -0.03, 0.08), 1.5, 0.25)
        moving = cockpit.cell.postures
        rest = cockpit.cell.joints.wait_for_rest()
        time.sleep(1.0)
        errors = np.array([_apart(robot, start, q) for q in moving])
        way, turn = _apart(robot, start, rest)
        told = {"mean in motion": errors.mean(axis=0), "most in motion": errors.max(axis=0), "at rest": (way, turn)}
        print(*(f"\n{what}: {1e3 * a:.2f} mm, {np.degrees(b):.2f} degrees" for what, (a, b) in told.items()))
        for arm in SIDES:
            moved = robot.tool_pose(rest, arm).translation - robot.tool_pose(start, arm).translation
            assert np.linalg.norm(moved) > 0.05
        assert way < 1e-3
        assert turn < np.radians(0.5)
        assert errors[:, 0].mean() < 0.02  # whatever else runs on the machine
        assert errors[:, 1].mean() < np.radians(5.0)
        assert call(node, "/cartesian_controller/pause", _pause()).success
        cockpit.rigs.wait(lambda rig: rig.state["state"] in ("lost", "paused"), "the controller's pause stops both")


def _pause() -> Any:
    from std_srvs.srv import SetBool

    return SetBool.Request(data=True)


def _apart(robot: Robot, start: Array, q: Array) -> tuple[float, float]:
    """By how much the relation of the tools differs from that at the start [m], [rad]."""
    wanted, found = (robot.tool_pose(at, "left").actInv(robot.tool_pose(at, "right")) for at in (start, q))
    turn = np.linalg.norm(pin.log3(found.rotation.T @ wanted.rotation))
    return float(np.linalg.norm(found.translation - wanted.translation)), float(turn)
