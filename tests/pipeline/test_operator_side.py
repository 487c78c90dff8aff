"""What an operator's hands feel of a run."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import ClassVar

import numpy as np

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.haptics import CONTACT, ENGAGED, FAULT, GRASP, LIMIT, NEAR, SLIP, Pulse
from q2r2_control.types import Array, HapticFeedback
from tests.support.hands_input import ENGAGED as BEGIN
from tests.support.hands_input import HandsInput, Path
from tests.support.operator_script import HANDS
from tests.support.processes import cell

UP = np.array([0.0, 0.0, 1.0])


class FeltHands(HandsInput):
    """Keeps what the hands feel, with the time of the tick."""

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
        """Amplitudes of the vibrations of a hand that have this frequency."""
        of = [one for _, one in self.felt if one.hand == hand and one.amplitude > 0.0]
        return [one.amplitude for one in of if one.frequency == pulse.frequency]


def straight(way: Array, duration: float = 1.5) -> Path:
    """From rest to rest along ``way`` [m], after both arms were engaged."""

    def path(t: float) -> Array:
        share = np.clip((t - BEGIN - 0.1) / duration, 0.0, 1.0)
        return np.append(share * share * (3.0 - 2.0 * share) * way, np.zeros(3))

    return path


def run(hands: FeltHands, duration: float, plant: str = "kinematic", listener: Callable | None = None) -> None:
    loop = Pipeline.from_config(cell().model_copy(update={"loop_rate_hz": 500.0}), input=hands, plant=plant)
    if listener is not None:
        loop.listeners.append(lambda tick: listener(loop, tick))
    loop.run(duration, realtime=False)


def test_engaging_is_felt_by_both_hands_and_every_vibration_ends_before_the_next_one_begins() -> None:
    hands = FeltHands(left=straight(0.25 * -np.eye(3)[1]))
    run(hands, 2.5)
    for hand in HANDS:
        assert hands.by(hand, ENGAGED) == [ENGAGED.amplitude]
        sent = [(t, one.amplitude > 0.0) for t, one in hands.felt if one.hand == hand]
        assert [on for _, on in sent] == [True, False] * (len(sent) // 2)
        assert all(0.03 < after - before < 0.4 for (before, on), (after, _) in pairwise(sent) if on)
        assert all(after - before > 0.04 for (before, on), (after, _) in pairwise(sent) if not on)


def test_an_arm_that_is_driven_at_the_other_is_felt_by_both_hands_stronger_and_stronger_and_then_no_more() -> None:
    hands = FeltHands(left=straight(0.5 * -np.eye(3)[1]))
    run(hands, 5.0)
    for hand in HANDS:
        amplitudes = hands.by(hand, NEAR)
        assert len(amplitudes) >= 4
        assert amplitudes == sorted(amplitudes)
    assert max(t for t, _ in hands.felt) < 4.0


def test_a_hand_that_goes_out_of_reach_feels_its_target_slip_and_one_that_turns_too_far_a_joint_at_its_limit() -> None:
    def turn(t: float) -> Array:
        return np.append(np.zeros(3), 40.0 * straight(0.1 * UP, 4.0)(t)[:3])

    hands = FeltHands(left=straight(1.2 * UP, 3.0), right=turn)
    run(hands, 6.0)
    assert len(hands.by("left", SLIP)) >= 5
    assert 1 <= len(hands.by("right", LIMIT)) <= 3
    assert not hands.by("left", LIMIT)


def test_a_push_at_the_tool_is_felt_by_its_hand_only() -> None:
    hands, pushed = FeltHands(), False

    def push(loop: Pipeline, tick: Tick) -> None:
        nonlocal pushed
        if tick.t > 1.0 and not pushed:
            pushed = True
            assert isinstance(loop.plant, MujocoPlant)
            loop.plant.push("right", np.array([0.0, 0.0, 22.0, 0.0, 0.0, 0.0]), 0.5)

    run(hands, 2.0, "mujoco", push)
    assert len(hands.by("right", CONTACT)) >= 1
    assert CONTACT.amplitude < max(hands.by("right", CONTACT)) < 0.6
    assert not hands.by("left", CONTACT)


def test_a_gripper_that_closes_on_a_block_is_felt_once_and_an_empty_one_is_not() -> None:
    class FeltScript(ScriptedInput):
        grasps: ClassVar[dict[str, int]] = {}

        def send_haptic(self, feedback: HapticFeedback) -> None:
            if feedback.frequency == GRASP.frequency and feedback.amplitude > 0.0:
                self.grasps[feedback.hand] = self.grasps.get(feedback.hand, 0) + 1

    script = FeltScript("grasp")
    config = cell().model_copy(update={"loop_rate_hz": 500.0})
    Pipeline.from_config(config, input=script, plant="mujoco").run(14.0, realtime=False)
    assert script.grasps == {"right": 1}


def test_a_refused_press_is_felt_as_a_fault_is() -> None:
    hands = FeltHands()
    loop = Pipeline.from_config(cell(), input=hands, plant="kinematic")
    loop.listeners.append(
        lambda tick: loop.teleop.pause(tick.now, Reason(ReasonKind.CONNECTION_LOST)) if tick.t > 0.5 else None
    )
    loop.run(0.6, realtime=False)
    assert hands.by("left", FAULT) == [1.0]
