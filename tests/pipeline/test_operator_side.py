"""The vibrations that the operator's hands feel during a run."""

from __future__ import annotations

from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest

from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.teleop.haptics import CONTACT, ENGAGED, GRASP, LIMIT, NEAR, SLIP, Pulse
from q2r2_control.types import SIDES, Array, HapticFeedback
from tests.pipeline.loops import pipeline
from tests.support.hands_input import ENGAGED as BEGIN
from tests.support.hands_input import HandsInput, Path

UP = np.array([0.0, 0.0, 1.0])


class FeltHands(HandsInput):
    """An input that stores the vibrations that the hands feel, with the time of the tick."""

    def __init__(self, **paths: Path) -> None:
        super().__init__(**paths)
        self.now = 0.0
        self.felt: list[tuple[float, HapticFeedback]] = []

    def poll(self, now: float) -> list:
        self.now = now
        return super().poll(now)

    def send_haptic(self, feedback: HapticFeedback) -> None:
        self.felt.append((self.now, feedback))

    def by(self, hand: str, pulse: Pulse) -> list[float]:
        """Return the amplitudes of a hand's vibrations that have the frequency of ``pulse``."""
        of = [one for _, one in self.felt if one.hand == hand and one.amplitude > 0.0]
        return [one.amplitude for one in of if one.frequency == pulse.frequency]


def straight(way: Array, duration: float = 1.5) -> Path:
    """Return a motion along ``way`` [m] from rest to rest, which begins after both arms were engaged."""

    def path(t: float) -> Array:
        share = np.clip((t - BEGIN - 0.1) / duration, 0.0, 1.0)
        return np.append(share * share * (3.0 - 2.0 * share) * way, np.zeros(3))

    return path


def test_engaging_is_felt_by_both_hands_and_every_vibration_ends_before_the_next_one_begins() -> None:
    hands = FeltHands(left=straight(0.25 * -np.eye(3)[1]))
    pipeline(hands).run(2.5, realtime=False)
    for hand in SIDES:
        assert hands.by(hand, ENGAGED) == [ENGAGED.amplitude]
        sent = [(t, one.amplitude > 0.0) for t, one in hands.felt if one.hand == hand]
        assert [on for _, on in sent] == [True, False] * (len(sent) // 2)
        assert all(0.03 < after - before < 0.4 for (before, on), (after, _) in pairwise(sent) if on)
        assert all(after - before > 0.04 for (before, on), (after, _) in pairwise(sent) if not on)


@pytest.mark.slow
def test_both_hands_feel_stronger_pulses_while_the_arms_come_closer_and_nothing_afterwards() -> None:
    hands = FeltHands(left=straight(0.5 * -np.eye(3)[1]))
    pipeline(hands).run(5.0, realtime=False)
    for hand in SIDES:
        amplitudes = hands.by(hand, NEAR)
        assert len(amplitudes) >= 4
        assert amplitudes == sorted(amplitudes)
    assert max(t for t, _ in hands.felt) < 4.0


@pytest.mark.slow
def test_a_hand_out_of_reach_feels_its_target_slip_and_a_hand_that_turns_too_far_feels_a_joint_limit() -> None:
    def turn(t: float) -> Array:
        return np.append(np.zeros(3), 40.0 * straight(0.1 * UP, 4.0)(t)[:3])

    hands = FeltHands(left=straight(1.2 * UP, 3.0), right=turn)
    pipeline(hands).run(6.0, realtime=False)
    assert len(hands.by("left", SLIP)) >= 5
    assert 1 <= len(hands.by("right", LIMIT)) <= 3
    assert not hands.by("left", LIMIT)


@pytest.mark.slow
def test_a_push_at_a_tool_is_felt_only_by_the_hand_that_drives_this_tool() -> None:
    hands = FeltHands()
    loop = pipeline(hands, "mujoco")
    plant = loop.plant
    assert isinstance(plant, MujocoPlant)
    force = np.array([0.0, 0.0, 22.0, 0.0, 0.0, 0.0])
    loop.listeners.append(lambda tick: plant.push("right", force, 0.5) if 1.0 <= tick.t < 1.002 else None)
    loop.run(2.0, realtime=False)
    assert len(hands.by("right", CONTACT)) >= 1
    assert CONTACT.amplitude < max(hands.by("right", CONTACT)) < 0.6
    assert not hands.by("left", CONTACT)


@pytest.mark.slow
def test_a_hand_feels_once_that_its_gripper_closes_on_a_block_and_does_not_feel_an_empty_gripper() -> None:
    class FeltScript(ScriptedInput):
        grasps: ClassVar[dict[str, int]] = {}

        def send_haptic(self, feedback: HapticFeedback) -> None:
            if feedback.frequency == GRASP.frequency and feedback.amplitude > 0.0:
                self.grasps[feedback.hand] = self.grasps.get(feedback.hand, 0) + 1

    script = FeltScript("grasp")
    pipeline(script, "mujoco").run(7.0, realtime=False)
    assert script.grasps == {"right": 1}
