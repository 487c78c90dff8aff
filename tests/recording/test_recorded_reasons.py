"""A recording with reasons of a package that is not installed is read like any other recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.errors import RecordingError
from q2r2_control.events import CommonReason, Event, Reason
from q2r2_control.export.episodes import FrameSampling, make_episode
from q2r2_control.judging.judge import Judged, judge_all
from q2r2_control.recording import messages, recorded_reasons
from q2r2_control.recording.messages import Message
from q2r2_control.recording.replay import replay
from q2r2_control.recording.ros_recording import events_of
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import ActionChunk
from q2r2_control.wording import sentence
from tests.recording.runs import file_of, pipeline, record, rewrite

PRESSED = f'"kind": "{TeleopReason.PRESSED}"'
ELSEWHERE = '"kind": "thermal_too_hot"'


def changed_events(file: Path, old: str, new: str, target: Path) -> Path:
    """Return a copy of a recording at ``target``, in which a text is replaced in each state."""

    def change(topic: str, message: Message) -> Message:
        if topic != messages.STATE:
            return message
        state = str(messages.data_of(message.payload, messages.TEXT))
        return message._replace(payload=messages.text(state.replace(old, new)))

    return rewrite(file, target, change)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return file_of(record(tmp_path_factory.mktemp("recordings"), pipeline(), 1.5))


def test_a_recording_with_an_unknown_kind_of_reason_is_read_judged_exported_and_replayed(
    file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    before = events_of(file)
    recorded_reasons._tell_missing.cache_clear()
    changed = changed_events(file, PRESSED, ELSEWHERE, tmp_path / "changed.mcap")
    after = events_of(changed)
    pressed = [place for place, event in enumerate(before) if event.kind is TeleopReason.PRESSED]
    assert len(pressed) == 2
    for place in pressed:
        assert after[place].kind is CommonReason.OTHER
        assert sentence(after[place].reason).startswith('thermal_too_hot {"')
    assert [replace(event, reason=old.reason) for event, old in zip(after, before, strict=True)] == before
    (original,), (one,) = judge_all([file]), judge_all([changed])
    assert isinstance(original, Judged)
    assert isinstance(one, Judged)
    assert one.figures.damage is None
    assert one.verdict == original.verdict
    assert len(make_episode(changed, FrameSampling(fps=30)).vectors["action"]) > 30
    assert replay(changed).ended_by is None
    (line,) = [line for line in caplog.messages if "thermal_too_hot" in line]
    assert line.endswith("install the package that wrote the recording")


def test_an_unknown_kind_is_also_read_as_the_cause_of_a_reason_and_as_the_fault_of_a_policy() -> None:
    unknown = {"kind": "thermal_too_hot", "detail": {"joint": "A4"}}
    text = 'thermal_too_hot {"joint": "A4"}'
    event = {"t": 1.0, "arm": "left", "from": "engaged", "to": "lost", "kind": "linked", "detail": {"arm": "right"}}
    read = recorded_reasons.event_of(event | {"cause": unknown})
    linked = Reason.of(TeleopReason.LINKED, cause=Reason.in_words(text), arm="right")
    assert read == Event(1.0, "left", "engaged", "lost", linked)
    chunk = ActionChunk(np.zeros(1), 0.1, fault=Reason.in_words("unusable")).as_json()
    assert recorded_reasons.chunk_of(chunk | {"fault": unknown}).fault == Reason.in_words(text)


def test_a_reason_without_a_kind_is_damage(file: Path, tmp_path: Path) -> None:
    changed = changed_events(file, PRESSED, '"kind": 3', tmp_path / "changed.mcap")
    with pytest.raises(RecordingError, match="damaged"):
        events_of(changed)
