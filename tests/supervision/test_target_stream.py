"""A stream of targets is followed if it began at the tool, and refused otherwise."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.supervision.target_stream import StreamSettings, TargetStream
from tests.supervision.conftest import raised

TOOL = pin.SE3(np.eye(3), np.array([0.5, 0.2, 0.4]))


def at_tool() -> list[pin.SE3]:
    """Return the only pose at which the streams of these tests may begin."""
    return [TOOL]


def unknown() -> list[pin.SE3]:
    raise AssertionError("an arm that follows a stream needs no tool poses")


def test_a_stream_may_move_anywhere_but_has_to_begin_at_the_tool_again_after_a_silence() -> None:
    stream = TargetStream(StreamSettings())
    assert stream.offer(TOOL, at_tool, 0.0) is None
    assert stream.offer(raised(TOOL, 0.2), unknown, 0.1) is None
    assert stream.pose == raised(TOOL, 0.2)
    assert stream.expire(0.5)
    refusal = stream.offer(raised(TOOL, 0.2), at_tool, 0.5)
    assert refusal is not None
    assert (refusal.kind, refusal.detail["distance"]) == (SupervisionReason.STREAM_AWAY, pytest.approx(0.2))
    assert not stream.following


def test_a_stream_that_began_away_from_the_tool_is_followed_after_a_jump_to_the_tool_or_a_silence() -> None:
    passing, jumping, silent = (TargetStream(StreamSettings()) for _ in range(3))
    for step in range(100):
        assert passing.offer(raised(TOOL, 0.5 - 0.01 * step), at_tool, 0.01 * step) is not None
    assert passing.pose is None
    for stream in (jumping, silent):
        assert stream.offer(raised(TOOL, 0.2), at_tool, 0.0) is not None
    assert jumping.offer(TOOL, at_tool, 0.01) is None
    assert silent.offer(raised(TOOL, 0.04), at_tool, 0.01) is not None
    assert silent.offer(TOOL, at_tool, 0.02) is not None  # This motion to the tool is too slow to count as a jump.
    assert not silent.expire(0.2)  # It ends a stream that the arm did not follow.
    assert silent.offer(TOOL, at_tool, 0.2) is None


def test_after_drop_a_target_stream_is_refused_until_reset_even_if_its_target_equals_the_tool_pose() -> None:
    stream = TargetStream(StreamSettings())
    assert stream.offer(TOOL, at_tool, 0.0) is None
    stream.drop()
    assert stream.offer(TOOL, at_tool, 0.01) is not None
    stream.reset()
    assert stream.offer(TOOL, at_tool, 0.02) is None
