"""A recording keeps the presses that begin subtasks, and judge and export find the subtasks in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import pytest

from q2r2_control.config.bindings import Action
from q2r2_control.config.recording import JudgeSettings, RecordingSettings
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import ReasonKind
from q2r2_control.export.episodes import FrameSampling, make_episode, spans_to_export
from q2r2_control.inputs.played import EvenSampling, PlayedInput
from q2r2_control.judging.judge import Judged, judge
from q2r2_control.recording.reader import Recording, read_spans
from q2r2_control.recording.replay import replay
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import SIDES, HandInputs
from tests.export.files import step_of_the_hand
from tests.recording.runs import file_of, pipeline, record

NAMES = ("reach", "grasp the cube", "place")
# Times at which the operator begins or ends an episode, and at which another subtask begins [s].
TOGGLED, NEXT = (0.4, 1.4, 1.8), (0.2, 0.7, 1.1, 1.6, 2.1)
PRESSED, DURATION = 0.08, 2.4  # Duration of a press, and of the run [s].


def operator(toggled: tuple[float, ...], following: tuple[float, ...]) -> Callable[[str, float], HandInputs]:
    def held(hand: str, t: float, begins: tuple[float, ...]) -> float:
        return float(hand == "left" and any(at <= t < at + PRESSED for at in begins))

    def controls(hand: str, t: float) -> HandInputs:
        lower = 0.1 <= t < 0.1 + PRESSED
        return HandInputs(button_lower=lower, press_index=held(hand, t, following), press_middle=held(hand, t, toggled))

    return controls


def recorded(
    folder: Path,
    toggled: tuple[float, ...],
    following: tuple[float, ...],
    names: tuple[str, ...] = NAMES,
    duration: float = DURATION,
) -> Path:
    teleop = TeleopSettings.model_validate({"bindings": {"grip": "record_toggle", "trigger": "next_subtask"}})
    source = PlayedInput(step_of_the_hand, operator(toggled, following), {side: EvenSampling(100.0) for side in SIDES})
    loop = pipeline(source=source, teleop=teleop, recording=RecordingSettings(subtasks=names))
    return file_of(record(folder, loop, duration))


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("subtasks"), TOGGLED, NEXT)


def told_in(file: Path) -> list[tuple[ReasonKind, dict[str, object]]]:
    events = [event for chunk in Recording(file).chunks() for told in chunk.events().values() for event in told]
    wanted = {
        TeleopReason.SUBTASK_BEGINS,
        TeleopReason.EPISODE_BEGINS,
        TeleopReason.EPISODE_ENDS,
        TeleopReason.LAST_SUBTASK,
        TeleopReason.NO_OPEN_EPISODE,
    }
    return [(event.kind, dict(event.reason.detail)) for event in events if event.kind in wanted]


def test_number_and_name_of_each_subtask_are_in_the_file(file: Path) -> None:
    assert told_in(file) == [
        (
            TeleopReason.SUBTASK_BEGINS,
            {"number": 2, "name": "grasp the cube"},
        ),  # No episode has begun yet, so the whole run may be one episode.
        (TeleopReason.EPISODE_BEGINS, {}),
        (TeleopReason.SUBTASK_BEGINS, {"number": 2, "name": "grasp the cube"}),
        (TeleopReason.SUBTASK_BEGINS, {"number": 3, "name": "place"}),
        (TeleopReason.EPISODE_ENDS, {}),
        (TeleopReason.NO_OPEN_EPISODE, {}),
        (TeleopReason.EPISODE_BEGINS, {}),
        (TeleopReason.SUBTASK_BEGINS, {"number": 2, "name": "grasp the cube"}),
    ]
    assert replay(file).difference is None


def test_in_the_last_subtask_a_press_for_the_next_one_is_refused_and_the_refusal_names_the_subtask(
    tmp_path: Path,
) -> None:
    file = recorded(tmp_path, (), (0.2, 0.4), NAMES[:2], duration=0.6)
    assert told_in(file)[-1] == (TeleopReason.LAST_SUBTASK, {"name": "grasp the cube"})


def test_each_episode_has_the_subtasks_that_were_begun_in_it(file: Path) -> None:
    first, second = read_spans(Recording(file))
    assert first.subtask_starts == pytest.approx((0.7 + PRESSED, 1.1 + PRESSED), abs=0.1)
    assert second.subtask_starts == pytest.approx((2.1 + PRESSED,), abs=0.1)


def subtasks_of(judged: Judged) -> list[tuple[str, float]]:
    return [(one.name, one.duration_s) for one in judged.figures.subtasks]


def test_subtasks_are_judged_by_their_own_durations(file: Path) -> None:
    settings = JudgeSettings(min_subtask_time=0.35, max_subtask_time=0.5, min_ldlj=None, max_idle_share=None)
    first, second = judge(Recording(file), settings)
    assert [name for name, _ in subtasks_of(first)] == list(NAMES)
    assert [length for _, length in subtasks_of(first)] == pytest.approx((0.3, 0.4, 0.3), abs=0.05)
    assert sum(length for _, length in subtasks_of(first)) == pytest.approx(first.figures.duration_s)
    reasons = {reason.text for reason in first.verdict.reasons if reason.name == "min_subtask_time"}
    assert {reason.split(" takes")[0] for reason in reasons} == {"subtask 1, reach:", "subtask 3, place:"}
    assert "max_subtask_time" not in {reason.name for reason in first.verdict.reasons}
    assert second.figures.missing_subtasks == ["place"]


def test_an_episode_in_which_a_named_subtask_is_missing_is_discarded_unless_the_settings_allow_it(file: Path) -> None:
    for needed, expected in ((True, [[], ["it has no place"]]), (False, [[], []])):
        judged = judge(Recording(file), JudgeSettings(needs_subtasks=needed))
        found = [[one.text for one in each.verdict.reasons if one.name == "needs_subtasks"] for each in judged]
        assert found == expected


def test_each_exported_frame_has_the_subtask_of_its_time(file: Path) -> None:
    first, second = (make_episode(file, FrameSampling(fps=100), span) for span in spans_to_export(file))
    assert (first.subtasks, second.subtasks) == (NAMES, NAMES[:2])
    lengths = [(index, len(list(frames))) for index, frames in groupby(first.subtask)]
    assert [index for index, _ in lengths] == [0, 1, 2]
    assert [length for _, length in lengths] == pytest.approx((30, 40, 30), abs=5)
    assert len(first.subtask) == first.frames


def test_subtasks_without_names_get_numbers_even_if_the_whole_run_is_one_episode(tmp_path: Path) -> None:
    file = recorded(tmp_path, (), (0.5, 0.9), (), duration=1.2)
    (span,) = spans_to_export(file)
    (judged,) = judge(Recording(file))
    names = ("subtask 1", "subtask 2", "subtask 3")
    assert make_episode(file, FrameSampling(), span).subtasks == names
    assert tuple(name for name, _ in subtasks_of(judged)) == names


def test_a_recording_without_reports_of_subtasks_has_no_subtasks(tmp_path: Path) -> None:
    file = recorded(tmp_path, (0.2, 0.7), (), (), duration=1.0)
    for span, judged in zip(spans_to_export(file), judge(Recording(file)), strict=True):
        episode = make_episode(file, FrameSampling(), span)
        assert (episode.subtasks, episode.subtask, judged.figures.subtasks) == ((), (), [])


def test_episodes_that_a_program_marks_are_found_even_if_no_control_is_bound_to_these_marks(tmp_path: Path) -> None:
    loop = pipeline("circle")
    asks = {0.2: Action.RECORD_TOGGLE, 0.4: Action.NEXT_SUBTASK, 0.6: Action.RECORD_TOGGLE}

    def ask(tick: Tick) -> None:
        for due in [due for due in asks if tick.t >= due]:
            loop.mark(asks.pop(due))

    loop.listeners.append(ask)
    (span,) = read_spans(Recording(file_of(record(tmp_path, loop, 0.8))))
    assert (span.number, span.end, len(span.subtask_starts)) == (1, pytest.approx(0.6, abs=0.05), 1)
    assert span == replace(span, discarded=False, success=None)
