"""Recordings and ROS messages contain events as data, without loss. Sentences about events are only for display."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from q2r2_control.events import CommonReason, Event, Reason
from q2r2_control.plugins import REASONS, load_class, names_of
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import HandFault
from q2r2_control.wording import sentence
from tests.support.modules import blocks_of, install

ROOMS = [CommonReason, *(load_class(REASONS, name) for name in names_of(REASONS))]

JUMPED = Reason.of(TeleopReason.HAND_JUMPED, distance=0.3)


def test_an_event_is_equal_after_a_round_trip_through_json() -> None:
    held = Reason.of(TeleopReason.CONTROLS_HELD, controls=["lower", "grip"])
    for reason in (Reason(TeleopReason.MARK), Reason.of(TeleopReason.LINKED, cause=JUMPED, arm="left"), held):
        event = Event(1.5, "right", "engaged", "lost", reason)
        assert Event.from_json(json.loads(json.dumps(event.as_json()))) == event


@pytest.mark.parametrize(
    "data", [{}, {"kind": "unheard of"}, {"kind": "mark", "cause": {}}, {"kind": "mark", "detail": 3}]
)
def test_data_that_are_not_a_reason_are_refused(data: dict[str, object]) -> None:
    with pytest.raises((KeyError, ValueError, TypeError)):
        Reason.from_json(data)


def test_every_kind_of_reason_has_a_sentence_and_every_fault_of_a_hand_is_a_kind_of_reason() -> None:
    assert all(kind.template for room in ROOMS for kind in room)
    assert {str(fault) for fault in HandFault} <= set(TeleopReason)


def test_no_two_subpackages_have_kinds_of_reasons_with_the_same_value() -> None:
    assert not [kind for kind, count in Counter(str(kind) for room in ROOMS for kind in room).items() if count > 1]


def test_the_example_reason_of_extending_md_is_restored_from_json_and_gives_its_sentence(tmp_path: Path) -> None:
    (source,) = [block for block in blocks_of("docs/extending.md", "python") if "class DriveReason" in block]
    install(tmp_path, "my_package", source, "[q2r2_control.reasons]\ndrives = my_package:DriveReason\n")
    recorded = {"kind": "drive_too_hot", "detail": {"joint": "A4", "allowed": 81.2}}
    code = f"""
from q2r2_control import Reason, sentence
reason = Reason.from_json({recorded})
assert reason.as_json() == {recorded}
print(sentence(reason))
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), *sys.path))}
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert said.stdout == "the drive of A4 is hotter than 81.2 degrees\n", said.stderr


def test_the_sentence_of_a_reason_contains_its_numbers_and_its_cause() -> None:
    assert (
        sentence(Reason.of(TeleopReason.LINKED, cause=JUMPED, arm="left")) == "linked to left: the hand jumped 0.300 m"
    )
    changes = Reason.of(TeleopReason.SETTINGS_REQUESTED, changes={"position_scale": 0.5})
    assert sentence(changes) == 'a program changes settings: {"position_scale": 0.5}'
