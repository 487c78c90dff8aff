"""The endpoint between a headset on real TCP and real topics in this process, and the view of both hands."""

from __future__ import annotations

import math
import re
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count as attempts
from pathlib import Path
from queue import Empty
from threading import Event, Lock, Thread
from typing import Any

import numpy as np

from tests.ros.conftest import need_ros
from tests.ros.processes import PATIENCE, ROOT, Processes, RosProcess, States, drained, subscribed, wait_until
from tests.support.fake_headset import KEEPALIVE, FakeHeadset

need_ros()

from geometry_msgs.msg import PoseStamped, Twist
from quest2ros.msg import OVR2ROSHapticFeedback, OVR2ROSInputs

IDENTITY = (0.0, 0.0, 0.0, -1.0)
CDR = b"\0\1\0\0"


def start_endpoint(processes: Processes, *parameters: str) -> tuple[RosProcess, tuple[str, int]]:
    process = processes.start_node("tcp_endpoint", "port:=0", *parameters)
    host, port = process.wait_for("listening on ").rsplit(" ", 1)[-1].split(":")
    return process, (host, int(port))


class KeepaliveHeadset(FakeHeadset):
    """A headset that sends keepalives like the app, so that the connection does not end on a slow machine."""

    def __init__(self, address: tuple[str, int], dialect: str = "ros2") -> None:
        super().__init__(address, dialect)
        self._sending, self._closed = Lock(), Event()
        self._thread = Thread(target=self._send_keepalives, daemon=True)
        self._thread.start()

    def send(self, data: bytes) -> None:
        with self._sending:
            super().send(data)

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        super().close()

    def _send_keepalives(self) -> None:
        with suppress(ConnectionError):
            while not self._closed.wait(0.5):
                self.send(KEEPALIVE)


class Hand:
    def __init__(self, node: Any, name: str) -> None:
        kinds = {"pose": PoseStamped, "twist": Twist, "inputs": OVR2ROSInputs}
        self.name = name
        self.queues = {what: subscribed(node, kind, f"q2r_{name}_hand_{what}") for what, kind in kinds.items()}

    def meet(self, headset: FakeHeadset) -> None:
        """Send until each topic has come, because a message may be lost before publisher and subscriber know each
        other.
        """
        for suffix, queue in self.queues.items():
            for attempt in attempts(1):
                probe = {
                    # Each attempt sends another pose, because frozen poses are left out.
                    "pose": headset.pose(self.name, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, float(attempt))),
                    "twist": headset.twist(self.name, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
                    "inputs": headset.inputs(self.name),
                }[suffix]
                headset.send(probe)
                with suppress(Empty):
                    queue.get(timeout=0.1)
                    break
                assert attempt < 10.0 * PATIENCE, f"no {suffix} of the {self.name} hand"

    def next(self, suffix: str, count: int) -> list[Any]:
        """Return the next ``count`` messages that are no probes. Some probes may still be on their way."""
        messages: list[Any] = []
        while len(messages) < count:
            message = self.queues[suffix].get(timeout=PATIENCE)
            if any(numbers(message)):
                messages.append(message)
        return messages


def numbers(message: Any) -> list[float]:
    """Return position, linear velocity or buttons, which are all zero in a probe."""
    if hasattr(message, "button_upper"):
        return [message.button_upper, message.button_lower, message.press_index]
    vector = message.linear if hasattr(message, "linear") else message.pose.position
    return [vector.x, vector.y, vector.z]


def test_headset_data_are_published_with_all_numbers(node: Any, processes: Processes) -> None:
    _, address = start_endpoint(processes, "right_frame_id:=base")
    hands = [Hand(node, name) for name in ("left", "right")]
    random = np.random.default_rng(3)
    with KeepaliveHeadset(address) as headset:
        headset.send(headset.registrations())
        for hand in hands:
            hand.meet(headset)
        for hand in hands:
            # The quaternions are not normalised, because the endpoint does not check this.
            poses = random.normal(size=(8, 7)).tolist()
            twists = random.normal(size=(8, 6)).tolist()
            asked = node.get_clock().now().nanoseconds
            for pose, twist in zip(poses, twists, strict=True):
                headset.send(headset.pose(hand.name, tuple(pose[:3]), tuple(pose[3:]), frame_id="room"))
                headset.send(headset.twist(hand.name, tuple(twist[:3]), tuple(twist[3:])))
            headset.send(headset.inputs(hand.name, True, False, (0.5, -0.5, 0.25, 1.0)))
            headset.send(headset.pose(hand.name, (math.nan, 1.0, math.inf), IDENTITY))
            *published, odd = hand.next("pose", 9)
            answered = node.get_clock().now().nanoseconds

            orientations = [message.pose.orientation for message in published]
            assert [numbers(message) for message in published] == [pose[:3] for pose in poses]
            assert [[q.x, q.y, q.z, q.w] for q in orientations] == [pose[3:] for pose in poses]
            frame = {"left": "room", "right": "base"}[hand.name]
            assert {message.header.frame_id for message in published} == {frame}
            stamps = [message.header.stamp.sec * 10**9 + message.header.stamp.nanosec for message in published]
            assert [asked, *stamps, answered] == sorted([asked, *stamps, answered])
            np.testing.assert_equal(numbers(odd), [math.nan, 1.0, math.inf])

            velocities = hand.next("twist", 8)
            assert [numbers(message) for message in velocities] == [twist[:3] for twist in twists]
            assert [[m.angular.x, m.angular.y, m.angular.z] for m in velocities] == [twist[3:] for twist in twists]
            (inputs,) = hand.next("inputs", 1)
            assert (inputs.button_upper, inputs.button_lower) == (True, False)
            sticks = (inputs.thumb_stick_horizontal, inputs.thumb_stick_vertical)
            assert (*sticks, inputs.press_index, inputs.press_middle) == (0.5, -0.5, 0.25, 1.0)


def test_only_networks_that_the_cell_or_a_parameter_allows_are_served(processes: Processes, tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    shipped = (ROOT / "config" / "dual_iiwa7.yaml").read_text(encoding="utf-8")
    cell.write_text(shipped.replace("allow: null", "allow: [127.0.0.2, 10.0.0.0/8]"), encoding="utf-8")
    process, address = start_endpoint(processes, f"config:={cell}")
    with FakeHeadset(address) as headset:
        assert b"127.0.0.1 is not in headset.allow" in headset.read_until("__error")
    with FakeHeadset(address, source="127.0.0.2") as headset:
        headset.send(headset.registrations())
        headset.read_until("__topic_list")
    assert process.interrupt() == 0
    refused = processes.start_node("tcp_endpoint", "port:=0", "allow:='the lab'")
    assert refused.wait() == 2
    assert "parameter allow: 'the lab' is neither an address nor a network" in refused.output


def test_a_headset_that_has_subscribed_gets_vibrations_byte_for_byte(node: Any, processes: Processes) -> None:
    _, address = start_endpoint(processes)
    haptic = node.create_publisher(OVR2ROSHapticFeedback, "q2r_right_hand_haptic_feedback", 10)
    with KeepaliveHeadset(address) as headset:
        headset.send(headset.registrations())
        headset.read_until("__topic_list")
        frame = None
        while frame is None:  # Publisher and endpoint need some time to discover each other.
            haptic.publish(OVR2ROSHapticFeedback(frequency=0.25, amplitude=7.0))
            with suppress(TimeoutError):
                frame = headset.read_frame(0.2)
        assert frame == ("q2r_right_hand_haptic_feedback", CDR + struct.pack("<2f", 0.25, 1.0))


def test_topics_are_silent_without_a_headset_and_a_second_headset_may_connect_later(
    node: Any, processes: Processes
) -> None:
    process, address = start_endpoint(processes)
    states = States(node, "tcp_endpoint")
    assert states.wait_for(peer=None)["level"] == "warn"
    hand = Hand(node, "left")
    with KeepaliveHeadset(address, "ros2") as headset:
        headset.send(headset.registrations())
        hand.meet(headset)
        headset.send(headset.pose("left", (1.0, 0.0, 0.0), IDENTITY) + headset.inputs("left", lower=True))
        hand.next("pose", 1)
        hand.next("inputs", 1)
        states.wait_for(level="ok", dialect="ROS2", connections=1)
    assert states.wait_for(peer=None)["last_disconnect"]
    time.sleep(0.5)
    assert all(not drained(queue) for queue in hand.queues.values()), "something was published that was not received"
    assert len(node.get_publishers_info_by_topic("/q2r_left_hand_pose")) == 1
    with KeepaliveHeadset(address, "ros1") as headset:
        headset.send(headset.registrations() + headset.pose("left", (2.0, 0.0, 0.0), IDENTITY))
        assert numbers(hand.next("pose", 1)[0]) == [2.0, 0.0, 0.0]
        states.wait_for(level="ok", dialect="ROS1", connections=2)
        headset.send(b"\xff" * 64)  # These bytes belong to no protocol.
        process.wait_for("dropped: frame of")
    assert process.interrupt() == 0


def test_frozen_poses_are_not_published_and_one_line_reports_them(node: Any, processes: Processes) -> None:
    process, address = start_endpoint(processes)
    hand, deadline = Hand(node, "left"), time.monotonic() + PATIENCE
    with KeepaliveHeadset(address) as headset:
        headset.send(headset.registrations())
        hand.meet(headset)
        while "left hand: " not in process.output:
            assert time.monotonic() < deadline
            headset.send(headset.pose("left", (1.0, 2.0, 3.0), IDENTITY))
            time.sleep(0.01)
        time.sleep(0.2)
        drained(hand.queues["pose"])
        for _ in range(20):
            headset.send(headset.pose("left", (1.0, 2.0, 3.0), IDENTITY))
        headset.send(headset.pose("left", (4.0, 5.0, 6.0), IDENTITY))
        assert numbers(hand.next("pose", 1)[0]) == [4.0, 5.0, 6.0]
    assert process.output.count("left hand: ") == 1


NAME = "CheckTCPconnection"
LONG = 2.0 * PATIENCE


@contextmanager
def left_hand_publishing(node: Any) -> Iterator[None]:
    """Publish pose, inputs and twist of the left hand with different numbers, while the context lasts."""
    from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Twist, Vector3
    from quest2ros.msg import OVR2ROSInputs

    pose = PoseStamped(pose=Pose(position=Point(x=1.0, y=2.0, z=-3.0), orientation=Quaternion(w=-1.0)))
    twist = Twist(linear=Vector3(x=0.5), angular=Vector3(z=-0.25))
    inputs = OVR2ROSInputs(button_lower=True, press_index=0.75)
    messages = {"pose": pose, "twist": twist, "inputs": inputs}
    publishers = {name: node.create_publisher(type(m), f"q2r_left_hand_{name}", 10) for name, m in messages.items()}
    timer = node.create_timer(0.02, lambda: [publishers[name].publish(m) for name, m in messages.items()])
    try:
        yield
    finally:
        node.destroy_timer(timer)


def test_the_view_shows_values_rate_and_age_and_reports_a_timeout(node: Any, processes: Processes) -> None:
    states = States(node, "check_tcp_connection")
    check = processes.start_node(NAME)
    with left_hand_publishing(node):
        check.wait_for("s old: 1.00 2.00 -3.00 m, quaternion 0.00 0.00 0.00 -1.00")
        check.wait_for("held: lower, triggers 0.8 0.0")
        state = states.wait_for(level="warn")
        assert state["rate_hz"]["q2r_left_hand_pose"] > 0.0
    wait_until(lambda: re.search(r"q2r_left_hand_pose: timeout, \d+ messages", check.output), "a timeout of the pose")
    states.wait_for(level="error")
    assert check.interrupt() == 0


def test_the_check_ends_after_its_duration_with_exit_code_1_if_nothing_has_arrived(processes: Processes) -> None:
    assert processes.start_node(NAME, "duration:=2.5").wait(LONG) == 1
