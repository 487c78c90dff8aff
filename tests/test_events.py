"""Events are data that recordings and ROS messages carry completely. Sentences are only for display."""

from __future__ import annotations

import json

import pytest

from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.types import HandFault
from q2r2_control.wording import sentence

JUMPED = Reason.of(ReasonKind.HAND_JUMPED, distance=0.3)


def test_an_event_is_equal_after_a_round_trip_through_json() -> None:
    held = Reason.of(ReasonKind.CONTROLS_HELD, controls=["lower", "grip"])
    for reason in (Reason(ReasonKind.MARK), Reason.of(ReasonKind.LINKED, cause=JUMPED, arm="left"), held):
        event = Event(1.5, "right", "engaged", "lost", reason)
        assert Event.from_json(json.loads(json.dumps(event.as_json()))) == event


@pytest.mark.parametrize(
    "data", [{}, {"kind": "unheard of"}, {"kind": "mark", "cause": {}}, {"kind": "mark", "detail": 3}]
)
def test_data_that_are_not_a_reason_are_refused(data: dict[str, object]) -> None:
    with pytest.raises((KeyError, ValueError, TypeError)):
        Reason.from_json(data)


def test_every_kind_has_a_sentence_and_every_fault_of_a_hand_is_a_kind() -> None:
    assert all(kind.template for kind in ReasonKind)
    assert {str(fault) for fault in HandFault} <= set(ReasonKind)


def test_a_sentence_shows_its_numbers_and_its_cause() -> None:
    assert sentence(Reason.of(ReasonKind.LINKED, cause=JUMPED, arm="left")) == "linked to left: the hand jumped 0.300 m"
    changes = Reason.of(ReasonKind.SETTINGS_REQUESTED, changes={"position_scale": 0.5})
    assert sentence(changes) == 'a program changes settings: {"position_scale": 0.5}'
