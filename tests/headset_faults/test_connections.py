"""Connections that end, fall silent, or deliver late: both arms stop, and only a new press engages them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.types import SIDES, Array
from tests.support.fake_headset import KEEPALIVE, FakeHeadset
from tests.support.headset_in_step import PERIOD, InStepRun, Operator

pytestmark = pytest.mark.slow

AWAY = pin.SE3(pin.exp3(np.array([0.2, 1.0, 0.3])), np.array([0.2, -0.1, 0.3]))
A_TICK = 0.002  # Period of the loop [s].


def go_elsewhere(op: Operator) -> Iterator[float]:
    """Move the hands while no arm follows them."""
    op.hands = {hand: place * AWAY for hand, place in op.hands.items()}
    yield 0.4


def engage_anew(op: Operator) -> Iterator[float]:
    yield 0.6  # During this time no press engages an arm, so no arm may move.
    yield from op.press(*SIDES)
    yield from op.move((0.0, 0.0, 0.05), seconds=0.3)


def assert_engaged_twice(run: InStepRun) -> None:
    assert [len(run.watch.engagements(arm)) for arm in SIDES] == [2, 2]
    assert run.states == {"engaged"}


def break_the_protocol(headset: FakeHeadset) -> None:
    headset.send(b"\xff" * 64)


@pytest.mark.parametrize("end", [FakeHeadset.reset, break_the_protocol])
def test_a_connection_that_ends_during_motion_stops_both_arms_until_a_new_press(
    end: Callable[[FakeHeadset], None],
) -> None:
    def script(op: Operator) -> Iterator[float]:
        yield from op.engage()
        yield from op.move((0.05, 0.05, 0.0), seconds=0.3)
        op.lose(end)
        yield from go_elsewhere(op)
        op.connect()
        yield from engage_anew(op)

    run = InStepRun(script)
    assert run.reasons("lost") == ["connection_lost"] * 2
    assert_engaged_twice(run)


@pytest.mark.parametrize("alive", [False, True], ids=["silent", "silent but for keepalives and buttons"])
def test_if_a_headset_sends_no_more_poses_during_motion_both_arms_stop_within_the_timeout(alive: bool) -> None:
    stopped = []

    def script(op: Operator) -> Iterator[float]:
        yield from op.engage()
        yield from op.move((0.05, 0.05, 0.0), seconds=0.3)
        stopped.append(op.now)
        if alive:
            op.send_pose = lambda hand, position, quaternion: KEEPALIVE
        op.silent = not alive
        yield from go_elsewhere(op)
        op.silent, op.send_pose = False, op.pose
        yield from engage_anew(op)

    run = InStepRun(script)
    assert "pose_silent" in run.reasons("lost")
    assert max(event.t for event in run.events if event.destination == "lost") <= stopped[0] + STREAM_TIMEOUT + A_TICK
    assert_engaged_twice(run)


def late_by(duration: float) -> Callable[[Operator], Iterator[float]]:
    """Return a script in which the network stands still twice, for ``duration`` [s] each time.

    The headset sends at an uneven rate of 30 to 72 Hz, and 5 % of its samples are lost.
    """

    def script(op: Operator) -> Iterator[float]:
        random = np.random.default_rng(7)

        def sent(hand: str, position: Array, quaternion: Array) -> bytes | None:
            op.period = float(random.uniform(PERIOD, 1.0 / 30.0))
            return None if random.random() < 0.05 else op.pose(hand, position, quaternion)

        op.send_pose = sent
        yield from op.engage()
        for _ in range(2):
            yield from op.move((0.0, 0.06, 0.06), seconds=0.3)
            op.held_up = True
            yield from op.move((0.0, 0.1 * duration, 0.1 * duration), seconds=duration)
            op.held_up = False
            yield from op.move((0.0, -0.06, -0.06), seconds=0.4)

    return script


def test_samples_that_come_in_bursts_within_the_timeout_are_followed_without_a_jump() -> None:
    run = InStepRun(late_by(0.08))
    assert run.reasons("lost") == []
    assert run.states == {"engaged"}


def test_a_network_delay_of_200_ms_stops_both_arms_and_the_late_samples_move_no_arm() -> None:
    run = InStepRun(late_by(0.2))
    assert "pose_silent" in run.reasons("lost")
    assert [len(run.watch.engagements(arm)) for arm in SIDES] == [1, 1]
    assert run.states == {"lost"}
