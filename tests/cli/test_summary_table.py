"""What the summary's table says of a run that did not go as asked."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO

import pytest
from rich.console import Console

from q2r2_control import Pipeline, RunSummary
from q2r2_control.cli.summary_table import recording_line, summary_table, task_line
from q2r2_control.demo.assembly_tasks import TaskResult
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.recording.recorder import RecordingSummary
from q2r2_control.summary.run_summary import Percentiles
from q2r2_control.wording import sentence
from tests.support.hands_input import HandsInput
from tests.support.processes import cell


@pytest.fixture(scope="module")
def summary() -> RunSummary:
    config = cell().model_copy(update={"loop_rate_hz": 100.0})
    return Pipeline.from_config(config, input=HandsInput(), plant="kinematic").run(0.5, realtime=False)


def text_of(summary: RunSummary) -> str:
    console = Console(file=StringIO(), width=160)
    console.print(summary_table(summary))
    file = console.file
    assert isinstance(file, StringIO)
    return file.getvalue()


def test_an_arm_that_was_paused_by_something_else_than_its_button_is_named_with_the_reason(
    summary: RunSummary,
) -> None:
    reason, press = Reason.of(ReasonKind.LOOP_STALLED, duration=0.4), Reason.of(ReasonKind.PRESSED, control="lower")
    paused = Event(4.07, "left", "engaged", "lost", reason)
    pressed = Event(4.5, "right", "pausing", "paused", press)
    text = text_of(replace(summary, events=[*summary.events, paused, pressed]))
    (row,) = (line for line in text.splitlines() if "left arm paused by" in line)
    assert f"{sentence(reason)}, at 4.07 s" in row
    assert "right arm paused by" not in text
    again = Event(5.0, "left", "paused", "engaged", press)
    assert "paused by" not in text_of(replace(summary, events=[paused, again]))
    refusal = Reason(ReasonKind.NOT_ENGAGED, cause=Reason(ReasonKind.TOOL_UNKNOWN))
    refused = Event(6.0, "left", "paused", "paused", refusal)
    text = text_of(replace(summary, events=[again, refused]))
    assert f"{sentence(refusal)}, at 6.00 s" in text


def test_late_and_missed_ticks_are_told_and_what_held_a_gripper(summary: RunSummary) -> None:
    assert "ticks late by" not in text_of(summary)
    assert "gripper held" not in text_of(summary)
    held = replace(summary.arms["left"], gripper_held_s=1.25, gripper_held_by=("left_finger_0", "block_0"))
    late = replace(summary, lateness_us=Percentiles(60.0, 310.0, 1204.0), overruns=3, missed_ticks=7, stretched_s=0.123)
    text = text_of(replace(late, arms=summary.arms | {"left": held}))
    assert "7, which made the motion 0.12 s late in all" in text
    assert "median 60 us, p99 310, max 1204; 3 by more than a period" in text
    (row,) = (line for line in text.splitlines() if "left gripper held for" in line)
    assert "1.25 s, by left_finger_0 | block_0" in row


@pytest.mark.parametrize(
    ("reason", "line"),
    [
        pytest.param("", "grasp succeeded (lifted 101.2 mm, put back 0.1 mm, held 1.8 s)", id="success"),
        pytest.param(
            "bar: fell 30 mm",
            "grasp failed: bar: fell 30 mm (lifted 101.2 mm, put back 0.1 mm, held 1.8 s)",
            id="failure",
        ),
    ],
)
def test_a_task_is_told_in_one_line_with_what_was_measured_and_what_fell_short(reason: str, line: str) -> None:
    measured = {"lifted_mm": 101.23, "put_back_mm": 0.1, "held_s": 1.8}
    console = Console(file=StringIO(), width=300)
    console.print(task_line(TaskResult("grasp", not reason, measured, reason)), highlight=False)
    file = console.file
    assert isinstance(file, StringIO)
    assert file.getvalue() == f"{line}\n"


def test_lost_pictures_are_said_with_the_reason() -> None:
    recorded = RecordingSummary("a.mcap", 100, 0, None, pictures=20, lost_pictures=3)
    assert recording_line(recorded).endswith(
        "100 ticks, 20 pictures, [red]3 lost[/]: they could not be taken fast enough)"
    )
    ended = replace(recorded, pictures_fault="no pictures: no OpenGL")
    assert recording_line(ended).endswith("[red]3 lost[/]: no pictures: no OpenGL)")
    assert recording_line(replace(recorded, pictures=0, lost_pictures=0)).endswith("(100 ticks)")
