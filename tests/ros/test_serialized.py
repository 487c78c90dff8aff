"""Messages read and written by the places of their numbers are what rclpy makes of them."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.ros.conftest import NEEDS_ROS

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("tf2_msgs", reason="needs tf2_msgs: q2r2 ros build-interfaces")

from builtin_interfaces.msg import Duration
from geometry_msgs.msg import PoseStamped, TransformStamped, Twist
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from q2r2_control.ros.bridge import serialized
from q2r2_control.ros.bridge.serialized import MessageReader, MessageWriter
from q2r2_control.types import Array

NAMES = [f"left_joint_{number}" for number in range(7)] + ["finger", "é"]
SPECIAL = (math.nan, -math.inf, -0.0, 5e-324, 1.7976931348623157e308)


def joint_state(names: list[str], *numbers: list[float]) -> JointState:
    position, velocity, effort = numbers
    return JointState(name=names, position=position, velocity=velocity, effort=effort)


def trajectory() -> JointTrajectory:
    numbers = [0.0] * len(NAMES)
    due = Duration(sec=1, nanosec=4_000_000)
    point = JointTrajectoryPoint(positions=numbers, velocities=numbers, time_from_start=due)
    return JointTrajectory(joint_names=NAMES, points=[point])


def transforms() -> TFMessage:
    """With names of all lengths, so that padding comes in all lengths too."""
    message = TFMessage()
    for length in range(9):
        transform = TransformStamped(child_frame_id="c" * length)
        transform.header.frame_id = "world"
        message.transforms.append(transform)
    return message


FULL = [0.0] * len(NAMES)
MESSAGES = {
    "joint states": joint_state(NAMES, FULL, FULL, FULL),
    "efforts alone": joint_state(NAMES, [], [], FULL),
    "names alone": joint_state(NAMES, [], [], []),
    "a trajectory of one point": trajectory(),
    "a pose": PoseStamped(),
    "a twist, without a stamp": Twist(),
    "transforms": transforms(),
}


def numbers_of(message: Any) -> Iterator[float]:
    """All float64 of a message, in the order of its fields."""
    for name, kind in message.get_fields_and_field_types().items():
        value = getattr(message, name)
        for one in value if kind.startswith("sequence<") else [value]:
            if hasattr(one, "get_fields_and_field_types"):
                yield from numbers_of(one)
            elif "double" in kind:
                yield one


def bits(values: Any) -> bytes:
    return np.array(list(values), np.float64).tobytes()


def random_numbers(count: int) -> Array:
    """With those among them that are no usual numbers."""
    numbers = np.random.default_rng(1).normal(size=count)
    numbers[: len(SPECIAL)] = SPECIAL[:count]
    return numbers


@pytest.mark.parametrize("message", MESSAGES.values(), ids=MESSAGES)
def test_what_is_written_is_what_rclpy_reads_and_writes_to_the_last_bit(message: Any) -> None:
    writer = MessageWriter(message)
    writer.numbers[:] = random_numbers(len(writer.numbers))
    data = writer.at(1234567890.25)
    theirs = deserialize_message(data, type(message))
    assert bits(numbers_of(theirs)) == bits(writer.numbers)
    # Byte by byte as rclpy writes the same message, but for padding, which it leaves as it is in memory.
    again = serialize_message(theirs)
    places = serialized._Places(theirs)
    assert len(data) == places.end <= len(again), "nothing follows the message, as may in what rclpy writes"
    for begin, end in (*places.fixed, *((at, at + 8) for at in (*places.numbers, *places.stamps))):
        assert data[begin:end] == again[begin:end]
    header = getattr(theirs, "header", None)
    if header is not None:
        assert (header.stamp.sec, header.stamp.nanosec) == (1234567890, 250_000_000)


@pytest.mark.parametrize("message", MESSAGES.values(), ids=MESSAGES)
def test_what_is_read_is_what_rclpy_reads_the_first_time_and_each_further_time(message: Any) -> None:
    writer, reader = MessageWriter(message), MessageReader(type(message))
    for t in (1.5, 2.75, 3.25):
        writer.numbers[:] = random_numbers(len(writer.numbers)) / t
        data = writer.at(t)
        theirs, read = deserialize_message(data, type(message)), reader.read(data)
        assert read is not None
        assert bits(read.values) == bits(numbers_of(theirs))
        assert read.stamp == (round(t * 1e9) if writer._places.stamps else 0)
        assert getattr(read.like, "name", None) == getattr(theirs, "name", None)


@pytest.mark.parametrize("message", MESSAGES.values(), ids=MESSAGES)
def test_with_a_middleware_that_serializes_in_another_way_rclpy_writes_and_reads(
    message: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(serialized, "_PLAIN_CDR", b"\x00\x07\x00\x00")
    writer, reader, parsed = MessageWriter(message), MessageReader(type(message)), Parsed(monkeypatch)
    for t in (1.5, 2.75):
        writer.numbers[:] = random_numbers(len(writer.numbers)) / t
        data = writer.at(t)
        read = reader.read(data)
        assert read is not None
        assert bits(read.values) == bits(numbers_of(deserialize_message(data, type(message)))) == bits(writer.numbers)
        assert read.stamp == (round(t * 1e9) if writer._places.stamps else 0)
    assert parsed.count == 2


class Parsed:
    """Counts how often a reader asks rclpy."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count = 0
        monkeypatch.setattr(serialized, "deserialize_message", self._deserialize)

    def _deserialize(self, data: bytes, kind: type) -> Any:
        self.count += 1
        return deserialize_message(data, kind)


def test_rclpy_reads_the_first_message_of_each_sender_only(monkeypatch: pytest.MonkeyPatch) -> None:
    parsed, reader = Parsed(monkeypatch), MessageReader(JointState)
    arms, gripper = joint_state(["a", "b"], [1.0, 2.0], [3.0, 4.0], []), joint_state(["g"], [5.0], [], [])
    for value in (1.0, 7.0, 8.0):
        arms.position[0] = value
        for message in (arms, gripper):
            read = reader.read(serialize_message(message))
            assert read is not None
            assert bits(read.values) == bits(numbers_of(message))
            assert read.like.name == message.name
    assert parsed.count == 2


CHANGES = {
    "another name": joint_state(["a", "c"], [1.0, 2.0], [3.0, 4.0], []),
    "names in another order": joint_state(["b", "a"], [1.0, 2.0], [3.0, 4.0], []),
    "fewer velocities": joint_state(["a", "b"], [1.0, 2.0], [3.0], []),
    "velocities called efforts": joint_state(["a", "b"], [1.0, 2.0], [], [3.0, 4.0]),
}


@pytest.mark.parametrize("other", CHANGES.values(), ids=CHANGES)
def test_what_differs_in_anything_but_numbers_is_read_by_rclpy(
    other: JointState, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader = MessageReader(JointState)
    reader.read(serialize_message(joint_state(["a", "b"], [1.0, 2.0], [3.0, 4.0], [])))
    parsed = Parsed(monkeypatch)
    read = reader.read(serialize_message(other))
    assert parsed.count == 1
    assert read is not None
    assert (read.like.name, list(read.like.velocity)) == (other.name, list(other.velocity))


def test_padding_may_be_anything(monkeypatch: pytest.MonkeyPatch) -> None:
    message = joint_state(["a", "bc"], [1.0, 2.0], [3.0, 4.0], [5.0, 6.0])
    data = bytearray(serialize_message(message))
    fixed = {at for begin, end in serialized._Places(message).fixed for at in range(begin, end)}
    places = serialized._Places(message)
    numbers = {at + step for at in (*places.numbers, *places.stamps) for step in range(8)}
    padding = sorted(set(range(places.end)) - fixed - numbers)
    assert len(padding) > 8
    reader, parsed = MessageReader(JointState), Parsed(monkeypatch)
    for fill in (0x00, 0xAA, 0xFF, 0x55):
        for at in padding:
            data[at] = fill
        read = reader.read(bytes(data))
        assert read is not None
        assert read.values.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert parsed.count == 1


def test_numbers_in_another_byte_order_are_read_by_rclpy_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    twist = Twist()
    twist.linear.x, twist.angular.z = 0.25, -3.0
    little = serialize_message(twist)
    big = b"\x00\x00\x00\x00" + struct.pack(">6d", *struct.unpack_from("<6d", little, 4))
    reader, parsed = MessageReader(Twist), Parsed(monkeypatch)
    for data in (little, big, little, big):
        read = reader.read(data)
        assert read is not None
        assert read.values.tolist() == [0.25, 0.0, 0.0, 0.0, 0.0, -3.0]
    assert parsed.count == 3


GOOD = serialize_message(joint_state(["a", "bcd"], [1.0, 2.0], [3.0, 4.0], [5.0, 6.0]))
LONG_NAME = GOOD.replace(b"\x04\x00\x00\x00bcd", b"\xff\xff\xff\x7fbcd")
BROKEN = {
    "nothing": b"",
    "a header alone": GOOD[:4],
    "cut off in a number": GOOD[:-4],
    "cut off": GOOD[:-20],
    "a length beyond the end": LONG_NAME,
}


@pytest.mark.parametrize("known", [False, True], ids=["before a good one", "after a good one"])
@pytest.mark.parametrize("data", BROKEN.values(), ids=BROKEN)
def test_bytes_that_are_no_message_are_none_as_a_subscription_drops_them(data: bytes, known: bool) -> None:
    reader = MessageReader(JointState)
    if known:
        assert reader.read(GOOD) is not None
    assert reader.read(data) is None
    read = reader.read(GOOD)
    assert read is not None
    assert read.values.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


def test_a_name_that_is_no_utf_8_is_read_as_rclpy_reads_it_each_time(monkeypatch: pytest.MonkeyPatch) -> None:
    odd = GOOD.replace(b"bcd", b"b\xe9d")
    reader, parsed = MessageReader(JointState), Parsed(monkeypatch)
    for _ in range(2):
        read = reader.read(odd)
        assert read is not None
        assert read.like.name == deserialize_message(odd, JointState).name
    assert parsed.count == 2


def test_senders_of_ever_other_names_do_not_make_it_remember_all_of_them() -> None:
    reader = MessageReader(JointState)
    for number in range(100):
        assert reader.read(serialize_message(joint_state([f"joint {number}"], [1.0], [], []))) is not None
    assert len(reader._layouts) <= serialized._KEPT


def test_what_is_written_is_read_by_others_who_look_at_its_length() -> None:
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
    for message in (joint_state(NAMES, [0.0] * 9, [], []), JointState()):
        writer = MessageWriter(message)
        writer.numbers[:] = random_numbers(len(writer.numbers))
        read = store.deserialize_cdr(writer.at(0.0), "sensor_msgs/msg/JointState")
        assert bits(read.position) == bits(writer.numbers)


def test_a_message_of_very_many_numbers_is_read_and_its_layout_not_kept() -> None:
    many = [float(number) for number in range(50_000)]
    reader = MessageReader(JointState)
    numbers = reader.read(bytes(serialize_message(joint_state([], many, [], []))))
    assert numbers is not None
    assert numbers.values.tolist() == many
    assert not reader._layouts


def test_layouts_in_use_are_kept_when_others_come_and_go() -> None:
    reader = MessageReader(JointState)
    ours = bytes(serialize_message(joint_state(["ours"], [1.0], [], [])))
    first = reader.read(ours)
    assert first is not None
    for other in range(3 * serialized._KEPT):
        assert reader.read(bytes(serialize_message(joint_state([f"other {other}"], [2.0], [], []))))
        again = reader.read(ours)
        assert again is not None
        assert again.like is first.like, "it was not read by rclpy anew"
