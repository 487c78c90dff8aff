"""Samples of hands: how poses and inputs are joined, how the loop gets samples, and which poses it must not follow.

Frozen poses and a moving frame are faults. Human motions are not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.inputs import moved_frame
from q2r2_control.inputs.messages import HandPose, HandTwist
from q2r2_control.inputs.moved_frame import Move
from q2r2_control.inputs.samples import SAMPLES_KEPT, HandsWatch, HandTracker, SampleQueue, Watched
from q2r2_control.inputs.session import Reception
from q2r2_control.inputs.way_points import minimum_jerk
from q2r2_control.types import SIDES, HandFault, HandInputs, HandSample
from tests.support.two_hands import PERIOD, TwoHands, carry, hand_pose, rest

PRESSED = HandInputs(button_lower=True)


def pose(x: float) -> HandPose:
    return HandPose(np.array([x, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, -1.0]), stamp=0.0, frame_id="")


def sample(t: float) -> HandSample:
    return HandSample("left", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), t, HandInputs(), t)


def test_each_sample_has_the_newest_pose_and_inputs_with_their_receipt_times_and_the_fault_of_its_pose() -> None:
    tracker = HandTracker()
    made = [
        tracker.update("left", pose(1.0), 10.0),
        tracker.update("left", PRESSED, 10.2),
        tracker.update("left", pose(2.0), 10.3, HandFault.FROZEN),
        tracker.update("left", HandInputs(), 10.4),
        tracker.update("left", pose(3.0), 10.5),
        tracker.update("left", HandTwist(np.zeros(3), np.zeros(3)), 10.6),
        tracker.update("right", PRESSED, 10.7),  # There is no sample of the right hand before its first pose.
        tracker.update("right", pose(4.0), 10.8),
    ]
    assert [one and (one.position[0], one.pose_stamp, one.inputs, one.inputs_stamp, one.fault) for one in made] == [
        (1.0, 10.0, HandInputs(), -math.inf, None),
        (1.0, 10.0, PRESSED, 10.2, None),
        (2.0, 10.3, PRESSED, 10.2, HandFault.FROZEN),
        (2.0, 10.3, HandInputs(), 10.4, HandFault.FROZEN),
        (3.0, 10.5, HandInputs(), 10.4, None),
        None,
        None,
        (4.0, 10.8, PRESSED, 10.7, None),
    ]


def test_a_full_queue_keeps_the_newest_samples() -> None:
    queue = SampleQueue()
    for index in range(1000):
        queue.put(sample(float(index)))
    assert [one.pose_stamp for one in queue.take()] == [float(index) for index in range(1000 - SAMPLES_KEPT, 1000)]


def test_a_loop_notices_a_lost_connection_whether_it_checks_before_or_after_it_takes_the_samples() -> None:
    for look_first in (True, False):
        queue = SampleQueue()
        queue.put(sample(1.0))
        queue.cut()
        queue.put(sample(5.0))  # This sample belongs to the next connection already.
        seen, stamps = [], []
        for _ in range(3):
            before = queue.is_cut
            stamps += [one.pose_stamp for one in queue.take()]
            seen.append(before if look_first else queue.is_cut)
        assert seen[0], "the loss was never seen"
        assert not seen[-1], "the new connection was never seen"
        assert stamps == [5.0], "the new connection's samples wait until the loss was seen"


Message = tuple[float, str, HandPose | HandInputs]
STEP_AT = 30 * PERIOD  # Time at which the frame steps [s].
CHORD, RELEASED = HandInputs(button_upper=True, button_lower=True), HandInputs()


def reception(hand: str, message: HandPose | HandInputs) -> Reception:
    return Reception(f"q2r_{hand}_hand_{'pose' if isinstance(message, HandPose) else 'inputs'}", hand, message)


def handed_on(messages: Iterable[Message], watch: HandsWatch | None = None) -> list[Watched]:
    watch = watch or HandsWatch()
    return [watched for t, hand, message in messages for watched in watch.receive(reception(hand, message), t)]


def faults(watched: Iterable[Watched]) -> set[tuple[str, HandFault]]:
    return {(one.reception.hand, one.fault) for one in watched if one.fault is not None}


def moved(samples: Iterable[Message], by: Callable[[float, str], pin.SE3]) -> Iterator[Message]:
    """Yield the poses as seen in a frame that moves. ``by(t, hand)`` is the frame's motion at the time ``t`` [s]."""
    for t, hand, pose in samples:
        assert isinstance(pose, HandPose)
        rotation = pin.Quaternion(pose.quaternion).matrix()
        yield t, hand, hand_pose(by(t, hand) * pin.SE3(rotation, pose.position))


def stepped(shift: float, degrees: float, hands: tuple[str, ...] = SIDES) -> Callable[[float, str], pin.SE3]:
    """Return the motion of a frame that steps once, by ``shift`` [m] and by ``degrees`` about the vertical axis."""
    step = pin.SE3(pin.exp3(np.array([0.0, 0.0, math.radians(degrees)])), shift * np.array([0.6, 0.0, 0.8]))
    return lambda t, hand: step if t >= STEP_AT and hand in hands else pin.SE3.Identity()


def resting(seed: int = 0) -> list[Message]:
    return list(TwoHands(rest, seed).samples(1.2))


def test_a_pose_that_stays_equal_to_the_last_bit_is_frozen_whatever_its_stamp() -> None:
    (_, _, pose), *_ = resting()
    assert isinstance(pose, HandPose)
    still = [(index * PERIOD, "left", replace(pose, stamp=float(index))) for index in range(60)]
    found = [one.stamp for one in handed_on(still) if one.fault is HandFault.FROZEN]
    assert found == [t for t, _, _ in still if t >= 0.5]
    changed = replace(pose, position=np.nextafter(pose.position, 1e9))
    assert handed_on([*still, (1.0, "left", changed)])[-1].fault is None
    # A real hand at rest is not frozen, since its sensor has noise.
    assert faults(handed_on(TwoHands(rest, 1, (0.0, 0.0), tremor=False, noise=1e-7).samples(2.0))) == set()


def test_a_hand_that_is_moved_with_keys_does_not_count_as_frozen_if_it_rests_without_noise() -> None:
    (_, _, pose), *_ = resting()
    watch = HandsWatch()
    virtual = Reception("q2r_left_hand_pose", "left", pose, virtual=True)
    for index in range(200):
        (watched,) = watch.receive(virtual, index * PERIOD)
        assert watched.fault is None


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("shift", "degrees"), [(0.015, 0.0), (0.0, 3.0), (0.4, 120.0)], ids=str)
def test_a_step_of_the_frame_is_a_fault_of_both_hands_from_the_first_pose_after_it(
    shift: float, degrees: float, seed: int
) -> None:
    watched = handed_on(moved(resting(seed), stepped(shift, degrees)))
    after = [one for one in watched if one.stamp >= STEP_AT]
    bad = [one for one in after if one.fault]
    assert faults(after) == {(hand, HandFault.FRAME_MOVED) for hand in SIDES}
    assert after[0] is bad[0]
    assert bad[0].stamp - STEP_AT < 0.05
    assert bad[-1].stamp - bad[0].stamp == pytest.approx(0.3, abs=2.0 * PERIOD)
    assert [one.fault for one in after[len(bad) :]] == [None] * (len(after) - len(bad))
    assert len(after) > len(bad)


def test_poses_after_a_step_of_one_hand_are_passed_on_in_order_so_that_the_gate_judges_them() -> None:
    for hand in SIDES:
        samples = list(moved(resting(), stepped(0.3, 0.0, (hand,))))
        watched = handed_on(samples)
        assert faults(watched) == set()
        assert sorted((one.stamp, one.reception.hand) for one in watched) == [(t, hand) for t, hand, _ in samples]
        for side in SIDES:
            stamps = [one.stamp for one in watched if one.reception.hand == side]
            assert stamps == sorted(stamps)


def test_the_pose_of_one_hand_does_not_wait_for_a_hand_that_sends_nothing() -> None:
    alone = [message for message in moved(resting(), stepped(0.1, 0.0)) if message[1] == "right"]
    watch = HandsWatch()
    for t, hand, pose in alone:
        assert [one.stamp for one in watch.receive(reception(hand, pose), t)] == [t]


@pytest.mark.parametrize("begins", [-0.03, 0.0001, 0.02], ids=str)
@pytest.mark.parametrize("first", SIDES)
def test_an_alignment_of_the_frame_is_no_fault_whether_its_buttons_or_its_poses_come_first(
    first: str, begins: float
) -> None:
    messages = [*moved(resting(), stepped(0.3, 60.0)), (STEP_AT + begins, first, CHORD)]
    messages.append((STEP_AT + begins + 0.15, first, RELEASED))
    watched = handed_on(sorted(messages, key=lambda message: message[0]))
    assert faults(watched) == set()
    assert watched[-1].stamp == max(t for t, _, _ in messages)


def test_after_the_release_of_the_chord_a_step_of_the_frame_is_a_fault_again() -> None:
    chord = [(0.05, "left", CHORD), (0.15, "left", RELEASED)]
    messages = sorted([*moved(resting(), stepped(0.1, 0.0)), *chord], key=lambda message: message[0])
    assert {hand for hand, _ in faults(handed_on(messages))} == set(SIDES)


def test_a_frame_that_turns_with_the_head_is_a_fault_of_both_hands() -> None:
    def nodding(t: float, hand: str) -> pin.SE3:
        """Return the motion of a frame that follows the head, which turns by 35 degrees in 1.2 s."""
        return pin.SE3(pin.exp3(np.array([0.0, 0.0, math.radians(35.0) * minimum_jerk(t / 1.2)])), np.zeros(3))

    coupled = list(moved(TwoHands(rest, 3, (0.0, 0.0), tremor=False).samples(1.5), nodding))
    assert faults(handed_on(coupled)) == {(hand, HandFault.FRAME_MOVED) for hand in SIDES}
    assert faults(handed_on(coupled, HandsWatch(frame=False))) == set()


@pytest.mark.parametrize("tremor", [True, False], ids=["trembling", "without tremor"])
@pytest.mark.parametrize("seed", [0, 1])
def test_human_hands_that_carry_a_light_box_do_not_count_as_a_moving_frame(
    seed: int, tremor: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("_CARRIED_TOLERANCE", "_STEP_TOLERANCE"):
        distance, angle = getattr(moved_frame, name)
        monkeypatch.setattr(moved_frame, name, Move(2.0 * distance, 2.0 * angle))
    assert faults(handed_on(TwoHands(carry, seed, tremor=tremor).samples(6.4))) == set()


def snatch(t: float) -> pin.SE3:
    """Return a motion to and fro by 0.2 m. It accelerates at 18 m/s^2 up to 1.2 m/s, and stops suddenly each time."""
    stroke, phase = divmod(t, 0.4)
    ramp = 1.2 / 18.0
    way = min(9.0 * min(phase, ramp) ** 2 + 1.2 * max(phase - ramp, 0.0), 0.2)
    return pin.SE3(np.eye(3), np.array([0.0, way if stroke % 2 == 0 else 0.2 - way, 0.0]))


@pytest.mark.parametrize("seed", [0, 1])
def test_fast_hands_with_lost_and_late_samples_do_not_count_as_a_moving_frame(seed: int) -> None:
    random = np.random.default_rng(seed)
    lost = {index for index in range(600) if random.random() < 0.05}
    samples = [
        (t if not 2.0 < t < 2.1 else 2.1, hand, pose)
        for index, (t, hand, pose) in enumerate(TwoHands(snatch, seed).samples(6.0))
        if index // 2 not in lost
    ]
    watched = handed_on(samples)
    assert faults(watched) == set()
    assert len(watched) >= len(samples) - 1


def test_hands_that_start_together_while_samples_are_lost_do_not_count_as_a_moved_frame() -> None:
    """Both hands accelerate at 16 m/s^2 for 60 ms, exactly like one rigid body. All samples of this time are lost."""

    def reach(t: float) -> pin.SE3:
        return pin.SE3(np.eye(3), np.array([0.0, 8.0 * min(max(t - STEP_AT, 0.0), 0.06) ** 2, 0.0]))

    rigid = TwoHands(reach, 0, (0.0, 0.0), tremor=False).samples(1.0)
    assert faults(handed_on(one for one in rigid if not STEP_AT < one[0] < STEP_AT + 0.06)) == set()
