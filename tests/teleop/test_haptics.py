"""The vibrations of a hand. Each of them ends."""

from __future__ import annotations

import re

import pytest

from q2r2_control.config.teleop import HapticSettings
from q2r2_control.events import CommonReason, Event, Reason, ReasonKind
from q2r2_control.teleop import haptics as pulses
from q2r2_control.teleop.haptics import VOCABULARY, ArmCondition, HapticPulses, Pulse
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import HapticFeedback
from tests.support.docs import table_rows


def event(source: str, destination: str, reason: Reason | ReasonKind) -> Event:
    return Event(1.0, "left", source, destination, reason if isinstance(reason, Reason) else Reason(reason))


def verdict(keep: bool) -> Reason:
    return Reason.of(TeleopReason.VERDICT, episode=2, keep=keep, line="")


JUMPED = event("engaged", "lost", TeleopReason.HAND_JUMPED)
EVENTS = {
    "engaging": (event("paused", "engaged", TeleopReason.PRESSED), pulses.ENGAGED),
    "pausing": (event("engaged", "pausing", TeleopReason.PRESSED), pulses.PAUSED),
    "a fault": (event("engaged", "lost", TeleopReason.POSE_SILENT), pulses.FAULT),
    "a refused press": (event("paused", "paused", TeleopReason.NOT_ENGAGED), pulses.FAULT),
    "an alignment that ends unengaged": (event("aligning", "lost", TeleopReason.NOT_ENGAGED), pulses.FAULT),
    "the way home": (event("paused", "homing", TeleopReason.COMMANDED), pulses.HOMING),
    "the end of the way home": (event("homing", "paused", CommonReason.HOMING_ARRIVED), pulses.PAUSED),
    "both arms carry, for the one that leads": (event("engaged", "engaged", TeleopReason.CARRY_BEGAN), pulses.ENGAGED),
    "both arms carry, for the other one": (event("paused", "carried", TeleopReason.CARRIED_BY), pulses.ENGAGED),
    "the end of carrying": (event("carried", "paused", TeleopReason.PRESSED), pulses.PAUSED),
    "an episode that begins": (event("lost", "lost", TeleopReason.EPISODE_BEGINS), pulses.EPISODE_BEGINS),
    "a subtask that begins": (event("paused", "paused", TeleopReason.SUBTASK_BEGINS), pulses.EPISODE_BEGINS),
    "an episode that is kept": (event("paused", "paused", verdict(True)), pulses.EPISODE_KEPT),
    "one that is not": (event("lost", "lost", verdict(False)), pulses.EPISODE_REJECTED),
    "an episode that ends": (event("engaged", "engaged", TeleopReason.EPISODE_ENDS), pulses.EPISODE_ENDS),
    "an episode that is discarded": (
        event("paused", "paused", TeleopReason.EPISODE_DISCARDED),
        pulses.EPISODE_DISCARDED,
    ),
    "a stop": (event("engaged", "stopped", TeleopReason.COMMANDED), pulses.STOPPED),
}


def feedback(pulse: Pulse) -> HapticFeedback:
    return HapticFeedback("left", pulse.frequency, pulse.amplitude)


@pytest.mark.parametrize(("happens", "pulse"), EVENTS.values(), ids=EVENTS)
def test_an_event_causes_one_vibration_that_ends(happens: Event, pulse: Pulse) -> None:
    haptics = HapticPulses()
    haptics.start_pulse(happens)
    assert haptics.at(1.0, "left") == feedback(pulse)
    assert haptics.at(1.0 + 0.9 * pulse.duration, "left") is None
    assert haptics.at(1.01 + pulse.duration, "left") == HapticFeedback("left", 0.0, 0.0)
    assert haptics.at(9.0, "left") is None


def test_a_vibration_comes_when_a_pause_begins_and_no_vibration_comes_when_the_pause_is_confirmed() -> None:
    haptics = HapticPulses()
    haptics.start_pulse(event("pausing", "paused", TeleopReason.PRESSED))
    assert haptics.at(1.0, "left") is None


def test_slip_is_felt_whenever_it_has_grown_by_a_step_and_again_after_a_new_engagement() -> None:
    haptics = HapticPulses()
    felt = []
    for tick in range(100):
        haptics.slip(0.001 * tick, 0.0)
        felt.append(haptics.at(tick * 0.1, "left"))
    assert felt.count(feedback(pulses.SLIP)) == 4
    haptics.slip(0.0, 0.0)
    haptics.slip(0.0, 0.11)
    assert haptics.at(20.0, "left") == feedback(pulses.SLIP)


def test_slip_that_grows_again_is_felt_only_if_it_had_shrunk_by_two_steps() -> None:
    haptics = HapticPulses()
    felt = []
    for number, steps in enumerate((3.1, 1.5, 3.1, 1.0, 3.1, 1.0, 0.0, 1.0)):
        haptics.slip(steps * 0.02, 0.0)
        felt.append(haptics.at(10.0 * number, "left") == feedback(pulses.SLIP))
        haptics.at(10.0 * number + 5.0, "left")  # The pulse ends.
    assert felt == [True, False, False, False, True, False, False, True]


def test_a_weaker_vibration_does_not_interrupt_a_stronger_one() -> None:
    haptics = HapticPulses()
    haptics.start_pulse(JUMPED)
    assert haptics.at(1.0, "left") == feedback(pulses.FAULT)
    haptics.slip(1.0, 0.0)
    assert haptics.at(1.1, "left") is None
    assert haptics.at(1.0 + pulses.FAULT.duration, "left") == HapticFeedback("left", 0.0, 0.0)


def felt(haptics: HapticPulses, since: float, until: float) -> list[HapticFeedback]:
    """Return all messages that are sent from ``since`` to ``until`` [s], at 1000 ticks a second."""
    ticks = range(round((until - since) * 1000))
    return [sent for tick in ticks if (sent := haptics.at(since + 0.001 * tick, "left")) is not None]


def condition(spare: float = 1.0, limits: tuple[str, ...] = (), force: float | None = None) -> ArmCondition:
    return ArmCondition(spare, frozenset(limits), force)


def test_an_approach_is_felt_every_5_mm_with_growing_strength_and_a_retreat_is_not_felt() -> None:
    haptics = HapticPulses()
    felt_at: list[float] = []
    for tick in range(200):  # The margin trembles while it falls from 60 mm to 0, and then it rises again.
        haptics.notice(condition(abs(0.06 - 0.0006 * tick) + (0.004 * (tick % 2) if tick < 100 else 0.0)))
        felt_at += [sent.amplitude for sent in felt(haptics, tick, tick + 1.0) if sent.amplitude > 0.0]
        if tick == 100:
            approaching = len(felt_at)
    assert approaching == len(felt_at) == 10
    assert felt_at == sorted(felt_at)
    assert pulses.NEAR.amplitude < felt_at[0] < felt_at[-1] == pytest.approx(0.6)


def test_a_contact_is_felt_every_5_newtons_and_more_strongly_at_larger_forces() -> None:
    haptics = HapticPulses()
    felt_at = []
    for tick in range(80):
        haptics.notice(condition(force=float(tick)))
        felt_at += [sent.amplitude for sent in felt(haptics, tick, tick + 1.0) if sent.amplitude > 0.0]
    assert len(felt_at) == 15
    assert pulses.CONTACT.amplitude < felt_at[0] < felt_at[5] < felt_at[-1] == pytest.approx(0.8)


def test_reaching_a_joint_limit_and_grasping_are_each_felt_once() -> None:
    haptics = HapticPulses()
    sent = []
    for tick in range(10):
        haptics.notice(condition(limits=("left_A2", "left_A4") if tick > 4 else ("left_A4",)))
        sent += felt(haptics, tick, tick + 1.0)
    assert [one for one in sent if one.amplitude] == [feedback(pulses.LIMIT)] * 2
    for tick in range(10, 20):
        haptics.grasps(tick != 15)
        sent += felt(haptics, tick, tick + 1.0)
    assert [one for one in sent if one.amplitude][2:] == [feedback(pulses.GRASP)] * 2


def test_a_second_vibration_waits_until_the_first_has_ended_but_a_fault_does_not_wait() -> None:
    haptics = HapticPulses()
    haptics.start_pulse(event("paused", "engaged", TeleopReason.PRESSED))
    first = felt(haptics, 1.0, 1.0 + pulses.ENGAGED.duration + 0.002)
    assert [one.amplitude for one in first] == [pulses.ENGAGED.amplitude, 0.0]
    haptics.notice(condition(limits=("left_A4",)))
    assert felt(haptics, 1.09, 1.12) == []
    assert felt(haptics, 1.12, 1.2)[0] == feedback(pulses.LIMIT)
    haptics.start_pulse(JUMPED)
    assert haptics.at(1.21, "left") == feedback(pulses.FAULT)


@pytest.mark.parametrize(("strength", "expected"), [(0.5, [0.5 * pulses.FAULT.amplitude, 0.0]), (0.0, [])])
def test_a_setting_scales_the_strength_of_all_vibrations_and_no_vibration_is_sent_if_the_setting_is_0(
    strength: float, expected: list[float]
) -> None:
    haptics = HapticPulses(HapticSettings(strength=strength))
    haptics.start_pulse(JUMPED)
    assert [sent.amplitude for sent in felt(haptics, 1.0, 2.0)] == expected


def test_if_two_vibrations_are_due_the_one_that_is_later_in_the_vocabulary_is_felt() -> None:
    amplitudes = [pulse.amplitude for pulse in VOCABULARY]
    assert amplitudes == sorted(amplitudes)
    haptics = HapticPulses()
    haptics.grasps(True)
    haptics.notice(condition(limits=("left_A4",)))
    assert haptics.at(0.0, "left") == feedback(pulses.GRASP)


def test_the_table_in_the_docs_equals_the_vocabulary() -> None:
    rows = [row for row in table_rows("operator.md") if row[-1].isdigit()]
    numbers = {meaning: [float(n) for n in re.findall(r"[\d.]+", " ".join(cells))] for meaning, *cells in rows}
    assert numbers.keys() == {pulse.meaning for pulse in VOCABULARY}
    for pulse in VOCABULARY:
        amplitudes = [pulse.amplitude, *([pulse.strongest] if pulse.strongest else [])]
        assert numbers[pulse.meaning] == pytest.approx([pulse.frequency, *amplitudes, 1e3 * pulse.duration])
