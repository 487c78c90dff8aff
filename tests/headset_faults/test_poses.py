"""Poses that change, or stay the same, without a motion of the hand: jumps, moving frames and frozen numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.types import SIDES, Array
from tests.support.headset_in_step import InStepRun, Operator, Sender

pytestmark = pytest.mark.slow

# Displacement by 0.5 m and 90 degrees.
AWAY = pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.5 * math.pi])), np.array([0.3, -0.4, 0.0]))
STILL = 5e-4  # Largest motion of a tool whose hand has only the noise of its sensor [m].


def assert_still(run: InStepRun) -> None:
    for tool in map(run.tool, SIDES):
        assert np.linalg.norm(tool - tool[0], axis=1).max() < STILL


def jumping(op: Operator, hands: tuple[str, ...], count: float) -> Sender:
    """Return a sender that moves the next ``count`` poses of ``hands`` by ``AWAY``, as a frame that has moved does."""
    left = dict.fromkeys(SIDES, 0.0) | dict.fromkeys(hands, count)

    def sent(hand: str, position: Array, quaternion: Array) -> bytes:
        seen = pin.SE3(pin.Quaternion(quaternion).matrix(), position)
        if left[hand] > 0:
            left[hand] -= 1
            seen = AWAY * seen
        return op.pose(hand, seen.translation, pin.Quaternion(seen.rotation).coeffs())

    return sent


@pytest.mark.parametrize(
    ("hands", "count"),
    [(("left",), 1), (("right",), math.inf), (SIDES, math.inf)],
    ids=["left, for one sample", "right, for good", "both, as a frame does"],
)
def test_a_jump_of_the_poses_moves_no_arm_and_stops_both_arms(hands: tuple[str, ...], count: float) -> None:
    def script(op: Operator) -> Iterator[float]:
        yield from op.engage()
        yield 0.2
        op.send_pose = jumping(op, hands, count)
        yield 0.8
        yield from op.press(*SIDES)
        yield 0.2

    run = InStepRun(script)
    lost = run.reasons("lost")
    assert len(lost) == 2
    assert all(reason.endswith("hand_frame_moved" if hands == SIDES else "hand_jumped") for reason in lost)
    assert_still(run)
    assert run.states == {"engaged"}


def test_a_step_of_the_frame_moves_no_arm_even_if_no_gate_finds_a_jump_of_a_hand() -> None:
    def script(op: Operator) -> Iterator[float]:
        yield from op.engage()
        yield 0.2
        op.frame = pin.SE3(np.eye(3), np.array([0.0, 0.012, 0.016]))
        yield 0.5

    run = InStepRun(script)
    assert run.reasons("lost") == ["hand_frame_moved"] * 2
    assert_still(run)


def test_frozen_poses_stop_both_arms_and_engage_no_arm_although_buttons_still_come() -> None:
    def script(op: Operator) -> Iterator[float]:
        yield from op.engage()
        yield from op.move((0.0, 0.05, 0.0), seconds=0.3)
        frozen: dict[str, bytes] = {}
        op.send_pose = lambda hand, position, quaternion: frozen.setdefault(hand, op.pose(hand, position, quaternion))
        yield 0.6
        yield from op.press(*SIDES)
        op.send_pose = op.pose
        yield 0.1
        yield from op.press(*SIDES)

    run = InStepRun(script)
    assert run.reasons("lost")[:2] == ["hand_frozen"] * 2
    assert run.reasons("lost")[2:] == ["not_engaged: hand_frozen"] * 2
    assert run.states == {"engaged"}
