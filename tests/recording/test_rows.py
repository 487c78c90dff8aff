"""Rows are the CDR that ROS 2 has: rosbags reads them, and writes the same bytes."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import pytest

from q2r2_control.inputs.messages import Dialect, message_types
from q2r2_control.recording.rows import HEAD, RowType, jpeg_of, log_time, picture_record, text_of, text_record
from q2r2_control.recording.topics import Topic, Topics

ARMS, JOINTS = ("left", "right"), ("left_A1", "left_A2", "right_A1_with_a_longer_name")
TOPICS = Topics(ARMS, JOINTS)


def filled(row: RowType, seed: int) -> Any:
    """One message of noise; times of day stay times of day, and buttons buttons."""
    rows, random = row.rows(7, 1), np.random.default_rng(seed)
    for name in rows.dtype.names or ():
        field = rows[name]
        if field.dtype.kind == "f":
            rows[name] = random.normal(size=field.shape)
        elif name not in ("channel", "sequence", "log_time", "publish_time"):
            rows[name] = random.integers(0, 2, size=field.shape)
    return rows


@pytest.mark.parametrize("topic", [topic for topic in TOPICS.all if topic.row], ids=lambda topic: topic.name)
def test_a_row_is_the_message_that_rosbags_writes(topic: Topic) -> None:
    assert topic.row is not None
    store = message_types(Dialect.ROS2)
    rows = filled(topic.row, topic.channel)
    payload = rows.tobytes()[HEAD.size :]
    message: Any = store.deserialize_cdr(payload, topic.type)
    assert bytes(store.serialize_cdr(message, topic.type)) == payload
    if topic.type.endswith("JointState"):
        assert message.name == list(JOINTS)
        np.testing.assert_array_equal(message.effort, rows["effort"][0])
        assert len(message.velocity) in (0, 3)
    if topic.type.endswith("JointTrajectory"):
        (point,) = message.points
        assert message.joint_names == list(JOINTS)
        np.testing.assert_array_equal(point.accelerations, rows["accelerations"][0])
    if topic.type.endswith("PoseStamped"):
        assert message.pose.orientation.w == rows["quaternion"][0, 3]
        assert message.header.frame_id in ("", "world")
    if topic.type.endswith("Float64MultiArray"):
        np.testing.assert_array_equal(message.data, rows["data"][0])
        assert len(message.data) == len(topic.labels["data"])
    if topic.type.endswith("OVR2ROSInputs"):
        assert message.press_middle == rows["press_middle"][0]


def test_the_head_of_a_row_is_that_of_an_mcap_message() -> None:
    topic = TOPICS.by_name["/q2r2/tick"]
    assert topic.row is not None
    rows = topic.row.rows(topic.channel, 2)
    rows["log_time"], rows["sequence"] = (3, 2**62), (1, 2)
    second = rows.tobytes()[rows.dtype.itemsize :]
    opcode, length, channel, sequence, logged, published = HEAD.unpack_from(second)
    assert (opcode, length, channel, sequence) == (5, len(second) - 9, topic.channel, 2)
    assert (logged, published) == (2**62, 0)
    assert log_time(second) == 2**62


def test_a_text_is_a_string_message() -> None:
    record = text_record(3, 1, 2, "grüezi")
    store = message_types(Dialect.ROS2)
    message: Any = store.deserialize_cdr(record[HEAD.size :], "std_msgs/msg/String")
    assert message.data == text_of(record) == "grüezi"


def test_every_number_of_an_array_has_a_name_of_its_own() -> None:
    for topic in TOPICS.all:
        for labels in topic.labels.values():
            assert len(set(labels)) == len(labels)


@pytest.mark.parametrize("length", [0, 1, 2, 3, 4, 5000, 5001])
def test_a_picture_of_any_length_is_read_as_it_was_also_where_a_middleware_filled_the_message_up(
    length: int,
) -> None:
    jpeg = bytes(number % 251 for number in range(length))
    record = picture_record(3, 7, 1_500_000_000, "front", jpeg)
    for padding in range(4):
        assert jpeg_of(record + bytes(padding)) == jpeg
    for wrong in (record + bytes(4), record[:-1]):
        with pytest.raises((ValueError, struct.error)):
            jpeg_of(wrong)
