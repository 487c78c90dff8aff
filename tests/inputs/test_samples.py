"""Samples join what travels apart; the queue keeps the newest and shows a lost connection."""

from __future__ import annotations

import numpy as np

from q2r2_control.inputs.messages import HandPose
from q2r2_control.inputs.samples import SAMPLES_KEPT, HandTracker, SampleQueue
from q2r2_control.types import HandFault, HandInputs, HandSample

PRESSED = HandInputs(button_lower=True)


def pose(x: float) -> HandPose:
    return HandPose(np.array([x, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, -1.0]), stamp=0.0, frame_id="")


def sample(t: float, hand: str = "left", upper: bool = False, lower: bool = False) -> HandSample:
    inputs = HandInputs(button_upper=upper, button_lower=lower)
    return HandSample(hand, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), t, inputs, t)


def test_each_sample_carries_the_newest_pose_and_inputs_with_their_own_receipt_times() -> None:
    tracker = HandTracker()
    first = tracker.update("left", pose(1.0), now=10.0)
    second = tracker.update("left", PRESSED, now=10.2)
    third = tracker.update("left", pose(2.0), now=10.3)
    assert first is not None
    assert second is not None
    assert third is not None
    assert (first.pose_stamp, first.inputs, first.inputs_stamp) == (10.0, HandInputs(), float("-inf"))
    assert (second.position[0], second.pose_stamp, second.inputs, second.inputs_stamp) == (1.0, 10.0, PRESSED, 10.2)
    assert (third.position[0], third.pose_stamp, third.inputs, third.inputs_stamp) == (2.0, 10.3, PRESSED, 10.2)


def test_inputs_before_the_first_pose_wait_for_it() -> None:
    tracker = HandTracker()
    assert tracker.update("left", PRESSED, now=1.0) is None
    joined = tracker.update("left", pose(0.0), now=2.0)
    assert joined is not None
    assert (joined.inputs, joined.inputs_stamp) == (PRESSED, 1.0)


def test_a_full_queue_keeps_the_newest_samples() -> None:
    queue = SampleQueue()
    for index in range(1000):
        queue.put(sample(float(index)))
    assert [one.pose_stamp for one in queue.take()] == [float(index) for index in range(1000 - SAMPLES_KEPT, 1000)]


def test_after_a_cut_nothing_of_the_lost_connection_comes_out() -> None:
    queue = SampleQueue()
    queue.put(sample(1.0))
    queue.cut()
    assert [queue.take() for _ in range(3)] == [[], [], []]


def test_a_cut_shows_at_one_look_per_tick_whether_before_or_after_the_take() -> None:
    for look_first in (True, False):
        queue = SampleQueue()
        queue.cut()
        queue.put(sample(5.0))  # of the next connection, already
        seen = []
        stamps = []
        for _ in range(3):
            if look_first:
                seen.append(queue.is_cut)
            stamps += [one.pose_stamp for one in queue.take()]
            if not look_first:
                seen.append(queue.is_cut)
        assert seen[0], "the loss was never seen"
        assert not seen[-1], "the new connection was never seen"
        assert stamps == [5.0], "the new connection's samples wait until the loss was seen"


def test_the_fault_of_a_pose_stays_with_it_until_the_next_pose() -> None:
    tracker = HandTracker()
    made = [
        tracker.update("left", pose(0.0), 1.0, HandFault.FROZEN),
        tracker.update("left", PRESSED, 1.01),
        tracker.update("left", pose(0.1), 1.02),
    ]
    assert [one.fault for one in made if one] == [HandFault.FROZEN, HandFault.FROZEN, None]
