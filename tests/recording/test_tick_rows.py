"""Numbers and messages in a file are those of the tick, and rosbags reads them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from q2r2_control.recording.messages import (
    ARRAY,
    JOINTS,
    PICTURE,
    STORE,
    TRAJECTORY,
    MessageTemplate,
    float_array,
    joint_state,
    joint_trajectory,
    jpeg_of,
    numbers_of,
    picture,
    text,
    text_of,
)
from q2r2_control.recording.tick_rows import numbers_in, tick_labels, tick_type

ARMS, NAMES = ("left", "right"), ("left_A1", "left_A2", "right_A1_with_a_longer_name")
STAMPS = np.array([1_500_000_000, (2**31 - 1) * 10**9])
POSITIONS, VELOCITIES, EFFORTS = (np.arange(first, first + 3, dtype=np.float64) for first in (1, 4, 7))


@pytest.mark.parametrize(
    ("kind", "example"),
    [
        (ARRAY, float_array(np.arange(1.0, 10.0))),
        (JOINTS, joint_state(list(NAMES), POSITIONS, VELOCITIES, EFFORTS)),
        (TRAJECTORY, joint_trajectory(list(NAMES), POSITIONS, VELOCITIES, EFFORTS)),
    ],
    ids=["array", "joint state", "trajectory"],
)
def test_a_filled_template_is_the_message_that_rosbags_writes(kind: str, example: Any) -> None:
    numbers = np.random.default_rng(0).normal(size=(2, 9))
    for row, stamp, payload in zip(
        numbers, STAMPS.tolist(), MessageTemplate(kind, example, 9).filled(numbers, STAMPS), strict=True
    ):
        message: Any = STORE.deserialize_cdr(payload, kind)
        assert bytes(STORE.serialize_cdr(message, kind)) == payload
        if kind == ARRAY:
            found = [message.data]
        elif kind == JOINTS:
            found = [message.position, message.velocity, message.effort]
        else:
            (point,) = message.points
            found = [point.positions, point.velocities, point.accelerations]
        np.testing.assert_array_equal(np.concatenate(found), row)
        if kind != ARRAY:
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp


def test_every_number_of_a_tick_has_a_name_of_its_own_and_its_place() -> None:
    labels, kind = tick_labels(ARMS, NAMES), tick_type(len(ARMS), len(NAMES))
    assert len(set(labels)) == len(labels) == kind.itemsize // 8
    rows = np.arange(2 * len(labels), dtype=np.float64).view(kind)
    np.testing.assert_array_equal(numbers_in(rows).ravel(), np.arange(2 * len(labels)))
    row = rows[0]
    for label, number in (
        ("index", row["index"]),
        ("tau_external.left_A2", row["tau_external"][1]),
        ("right.holding", row["arms"]["holding"][1]),
        ("left.target.qw", row["arms"]["target"][0, 6]),
        ("slack", row["slack"]),
        ("command_tau.left_A1", row["command_tau"][0]),
        ("solve_time", row["solve_time"]),
    ):
        assert number == labels.index(label)


def test_arrays_and_texts_are_read_as_they_were_written_and_no_others() -> None:
    numbers = np.array([[0.5, np.nan, -0.0], [1.0, np.inf, 2.0]])
    payloads = MessageTemplate(ARRAY, float_array(np.arange(1.0, 4.0)), 3).filled(numbers, STAMPS)
    assert numbers_of(payloads, 3).tobytes() == numbers.tobytes()
    with pytest.raises(ValueError, match="has not 4 numbers"):
        numbers_of(payloads, 4)
    assert text_of(text("grüezi")) == "grüezi"


@pytest.mark.parametrize("length", [0, 1, 2, 3, 4, 5001])
def test_a_picture_is_read_as_it_was_also_where_a_middleware_filled_the_message_up(length: int) -> None:
    jpeg = bytes(number % 251 for number in range(length))
    payload = picture("front", 1_500_000_000, jpeg)
    message: Any = STORE.deserialize_cdr(payload, PICTURE)
    assert (message.header.frame_id, message.format) == ("front", "jpeg")
    for padding in range(4):
        assert jpeg_of(payload + bytes(padding)) == jpeg
