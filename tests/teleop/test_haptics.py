"""What a hand feels, and that every vibration ends."""

from __future__ import annotations

import pytest

from q2r2_control.teleop.haptics import ENGAGED, FAULT, PAUSED, SLIP, HapticPulses, Pulse
from q2r2_control.types import Event, HapticFeedback

EVENTS = {
    "engaging": (("paused", "engaged", "lower button"), ENGAGED),
    "pausing": (("engaged", "pausing", "lower button"), PAUSED),
    "the alignment chord": (("engaged", "aligning", "alignment chord"), PAUSED),
    "a fault": (("engaged", "paused", "no pose for 0.15 s"), FAULT),
    "a refused press": (("paused", "paused", "not engaged: the tool's pose is not known"), FAULT),
    "an alignment that ends unengaged": (("aligning", "paused", "not engaged: the newest pose is not usable"), FAULT),
}


def feedback(pulse: Pulse) -> HapticFeedback:
    return HapticFeedback("left", pulse.frequency, pulse.amplitude)


@pytest.mark.parametrize(("event", "pulse"), EVENTS.values(), ids=EVENTS)
def test_an_event_is_felt_once_and_ends(event: tuple[str, str, str], pulse: Pulse) -> None:
    haptics = HapticPulses("left")
    haptics.tell(Event(1.0, "left", *event))
    assert haptics.at(1.0) == feedback(pulse)
    assert haptics.at(1.0 + 0.9 * pulse.duration) is None
    assert haptics.at(1.01 + pulse.duration) == HapticFeedback("left", 0.0, 0.0)
    assert haptics.at(9.0) is None


def test_a_pause_that_is_complete_is_not_felt_again() -> None:
    haptics = HapticPulses("left")
    haptics.tell(Event(1.0, "left", "pausing", "paused", "lower button"))
    assert haptics.at(1.0) is None


def test_slipping_is_felt_at_every_stretch_of_it_and_anew_after_engaging() -> None:
    haptics = HapticPulses("left")
    felt = []
    for tick in range(100):
        haptics.slip(0.001 * tick, 0.0)
        felt.append(haptics.at(tick * 0.1))
    assert felt.count(feedback(SLIP)) == 4
    haptics.slip(0.0, 0.0)
    haptics.slip(0.0, 0.11)
    assert haptics.at(20.0) == feedback(SLIP)


def test_a_weaker_vibration_does_not_cut_a_stronger_one_short() -> None:
    haptics = HapticPulses("left")
    haptics.tell(Event(1.0, "left", "engaged", "paused", "the hand jumped"))
    assert haptics.at(1.0) == feedback(FAULT)
    haptics.slip(1.0, 0.0)
    assert haptics.at(1.1) is None
    assert haptics.at(1.0 + FAULT.duration) == HapticFeedback("left", 0.0, 0.0)
