"""Tables print all of their cells, even in a terminal of 80 columns."""

from __future__ import annotations

import io
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
from rich.console import Console
from rich.table import Table

from q2r2_control import Pipeline, RunSummary
from q2r2_control.cli.cell_run import CellRun, print_summary
from q2r2_control.cli.output import ProgressLines, late_line, verdict_markup
from q2r2_control.cli.summary_figures import summary_table, verdict_line
from q2r2_control.demo.assembly_tasks import TaskResult, held_to_promises
from q2r2_control.events import CommonReason, Event, Reason
from q2r2_control.judging.judge import Verdict
from q2r2_control.judging.thresholds import Rejection
from q2r2_control.summary.run_summary import Percentiles, TorqueSummary
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.viewer.tables import figure_table, print_table
from q2r2_control.wording import sentence
from tests.support.hands_input import HandsInput
from tests.support.processes import cell

LINK = "left_arm_left_gripper_left_finger_joint_with_a_long_name_indeed"


def printed(table: Table, width: int = 80, terminal: bool = True) -> str:
    console = Console(file=io.StringIO(), width=width, force_terminal=terminal, color_system=None)
    print_table(table, console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_table_in_80_columns_has_complete_figures_names_units_and_notes() -> None:
    columns = ("joint", "min [rad]", "speed [rad/s]", "says")
    row = (f"{LINK}_{LINK}", -12.566, "10.472", "nothing is wrong with this joint as far as is known")
    text = printed(figure_table("one arm [m]", columns, [("a heading [x]",), row], ["[rad] is a unit, not a style"]))
    for expected in ("one arm [m]", "[rad]", "[rad/s]", "a heading [x]", "-12.6", "10.472", "[rad] is a unit, not"):
        assert expected in text
    assert "…" not in text
    first = "".join(line[1:].split(" ")[0] for line in text.splitlines())
    assert f"{LINK}_{LINK}" in first


def test_a_note_is_wrapped_only_on_a_terminal() -> None:
    note = "nothing arrives for 2 s, although the address and the port are those of the app"
    table = partial(figure_table, "hands", ("hand", "rate [Hz]"), [("left", 0.0)], [note])
    assert note not in printed(table())
    assert note in printed(table(), terminal=False).splitlines()


def test_no_figure_is_cut_however_narrow_the_console_is() -> None:
    columns = (
        "controller",
        *(f"{what} [us]" for what in ("free air", "carry", "crossing", "worst margin", "fallback")),
    )
    figures = ("-2.967", "123.456", "-9999.9", "176.000", "1234567")
    text = printed(figure_table("ticks", columns, [("q2r2_control", *figures), ("another_controller", *figures)]), 30)
    for line in (line.split() for line in text.splitlines() if "-2.967" in line):
        assert line[-len(figures) :] == list(figures)
        assert line[0].startswith(("q2r2", "another"))
    assert text.count("-2.967") == 2


def test_a_unit_of_several_words_is_under_its_name() -> None:
    text = printed(figure_table("runs", ("run", "error [mm RMS]", "load /core"), [("a", "2.3", "0.5")]))
    assert "[mm RMS]" in text
    assert "error [mm" not in text
    assert "load /core" not in text


def test_cells_of_a_table_have_no_line_break_if_another_program_reads_them() -> None:
    pair = "left_hand_e_base | right_hand_e_base"
    table = figure_table("pairs", ("pair", "why", "other pair"), [(pair, "keep", pair)])
    assert pair not in printed(table, 50)
    assert printed(table, 50, terminal=False).count(pair) == 2


@pytest.fixture(scope="module")
def summary() -> RunSummary:
    config = cell().model_copy(update={"loop_rate_hz": 100.0})
    return Pipeline.from_config(config, input=HandsInput(), plant="kinematic").run(0.5, realtime=False)


def text_of(summary: RunSummary, verbose: bool = True) -> str:
    return printed(summary_table(summary, verbose), width=160)


def test_the_verdict_names_the_faults_or_says_that_there_are_none(summary: RunSummary) -> None:
    still = {name: replace(arm, engaged_s=0.0) for name, arm in summary.arms.items()}
    good = replace(summary, arms=still | {"left": replace(still["left"], engaged_s=0.4)}, events=[])
    assert verdict_line(good) == "[green]as it should be[/]: left followed, every tick certified, at rest at the end"
    assert verdict_line(good, ["task stack failed"]) == "[red]not as it should be[/]: task stack failed"
    assert verdict_line(replace(good, arms=still)).startswith("[yellow]no arm was engaged[/]")
    reason = Reason.of(CommonReason.LOOP_STALLED, duration=0.4)
    stopped = verdict_line(replace(good, events=[Event(0.3, "left", "engaged", "lost", reason)]))
    assert stopped == f"[yellow]an arm was stopped or refused[/]: left arm {sentence(reason)}"
    off = good.arms | {"right": replace(good.arms["right"], end_error_mm=130.0)}
    bad = verdict_line(replace(good, uncertified_ticks=3, at_rest=False, arms=off))
    assert bad == (
        "[red]not as it should be[/]: right arm is 130 mm from its reference at the end; "
        "3 ticks without a certificate; arms move at the end"
    )


def test_a_run_in_which_an_arm_refused_every_press_has_a_fault(summary: RunSummary) -> None:
    refused = Event(
        6.0, "left", "paused", "paused", Reason(TeleopReason.NOT_ENGAGED, cause=Reason(TeleopReason.TOOL_UNKNOWN))
    )
    arms = {name: replace(arm, engaged_s=0.0) for name, arm in summary.arms.items()}
    never = replace(summary, events=[refused], arms=arms)
    assert never.broken == (f"left arm {sentence(refused.reason)}, at every press",)
    engaged_later = arms | {"left": replace(arms["left"], engaged_s=0.4)}
    assert replace(never, arms=engaged_later).broken == ()


def test_several_reasons_of_a_verdict_are_printed_in_separate_lines() -> None:
    late, idle = Rejection("max_delay", "late [s]"), Rejection("max_idle_share", "idle")
    assert verdict_markup(Verdict((late, idle))) == "[red]discard[/]:\n    late \\[s]\n    idle"
    assert verdict_markup(Verdict((late,))) == "[red]discard[/]: late \\[s]"
    assert verdict_markup(Verdict(())) == "[green]keep[/]"


def test_the_output_of_a_run_begins_with_its_verdict_and_the_results_of_its_tasks(
    summary: RunSummary, capsys: pytest.CaptureFixture[str]
) -> None:
    tasks = (TaskResult("grasp", True, {}, ""), TaskResult("stack", False, {}, "it fell"))
    print_summary(CellRun(replace(summary, events=[]), tasks), json=False)
    verdict, grasp, stack, *figures = capsys.readouterr().out.splitlines()
    assert verdict == "not as it should be: task stack failed"
    assert (grasp, stack) == ("grasp succeeded ()", "stack failed: it fell ()")
    assert any("duration" in line for line in figures)


def test_tasks_of_a_stopped_run_are_not_judged_unless_they_succeeded(
    summary: RunSummary, capsys: pytest.CaptureFixture[str]
) -> None:
    tasks = (TaskResult("grasp", True, {}, ""), TaskResult("stack", False, {}, "it fell"))
    stopped = CellRun(replace(summary, events=[], duration_s=12.0), tasks, planned=45.2)
    print_summary(stopped, json=False)
    verdict, grasp, *figures = capsys.readouterr().out.splitlines()
    assert verdict == "stopped after 12.0 of 45.2 s: not judged: stack"
    assert grasp == "grasp succeeded ()"
    assert not any("it fell" in line for line in figures)
    print_summary(replace(stopped, summary=replace(stopped.summary, uncertified_ticks=3)), json=False)
    assert capsys.readouterr().out.startswith("not as it should be: 3 ticks without a certificate\n")


def test_the_summary_is_short_without_verbose_but_never_hides_faults(summary: RunSummary) -> None:
    short, whole = text_of(summary, verbose=False), text_of(summary)
    for figure in ("input to command", "room to position limits", "velocity, acceleration", "certified stops"):
        assert figure not in short
        assert figure in whole
    for figure in ("duration", "left arm", "nearest pair", "arms at the end"):
        assert figure in short
        assert figure in whole
    torque = TorqueSummary({"left": 0.5}, min_measured_distance_mm=-2.0, measured_closest_pair=("a", "b"))
    wrong = text_of(replace(summary, fallback_ticks=4, rejected_targets=2, torque=torque), verbose=False)
    for figure in ("certified stops executed", "targets rejected", "measured links met: -2.0 mm", "off its reference"):
        assert figure in wrong


def test_the_summary_gives_the_reason_if_an_arm_was_paused_by_something_else_than_a_press(
    summary: RunSummary,
) -> None:
    reason, press = Reason.of(CommonReason.LOOP_STALLED, duration=0.4), Reason.of(TeleopReason.PRESSED, control="lower")
    paused = Event(4.07, "left", "engaged", "lost", reason)
    pressed = Event(4.5, "right", "pausing", "paused", press)
    text = text_of(replace(summary, events=[*summary.events, paused, pressed]))
    (row,) = (line for line in text.splitlines() if "left arm paused by" in line)
    assert f"{sentence(reason)}, at 4.07 s" in row
    assert "right arm paused by" not in text
    again = Event(5.0, "left", "paused", "engaged", press)
    went_on = text_of(replace(summary, events=[paused, again]))
    assert "at 4.07 s" in went_on, "a pause does not vanish because the arm was engaged again"
    later = replace(paused, t=274.51)
    text = text_of(replace(summary, events=[paused, again, later]))
    (row,) = (line for line in text.splitlines() if "left arm paused by" in line)
    assert "at 274.51 s, the last of 2 pauses" in row
    refusal = Reason(TeleopReason.NOT_ENGAGED, cause=Reason(TeleopReason.TOOL_UNKNOWN))
    refused = Event(6.0, "left", "paused", "paused", refusal)
    text = text_of(replace(summary, events=[again, refused]))
    assert f"{sentence(refusal)}, at 6.00 s" in text


def test_the_summary_has_late_and_missed_ticks_and_the_pair_that_held_a_gripper_back(summary: RunSummary) -> None:
    assert "ticks late by" not in text_of(summary)
    assert "gripper held" not in text_of(summary)
    held = replace(summary.arms["left"], gripper_held_s=1.25, gripper_held_by=("left_finger_0", "block_0"))
    late = replace(summary, lateness_us=Percentiles(60.0, 310.0, 1204.0), overruns=3, missed_ticks=7, stretched_s=0.123)
    text = text_of(replace(late, arms=summary.arms | {"left": held}))
    assert f"7 of {summary.ticks + 7}; the motion took 0.12 s longer" in text
    assert "median 60 us, p99 310, max 1204; 3 by more than a period" in text
    (row,) = (line for line in text.splitlines() if "left gripper held for" in line)
    assert "1.25 s, by left_finger_0 | block_0" in row


def test_if_a_task_fails_and_the_loop_was_late_a_line_says_how_late(summary: RunSummary) -> None:
    failed, done = TaskResult("grasp", False, {}, "bar: fell 30 mm"), TaskResult("stack", True, {}, "")
    late = replace(summary, lateness_us=Percentiles(60.0, 310.0, 239_400.0))
    line = late_line(late, [done, failed])
    assert line is not None
    assert "late by up to 239 ms" in line
    assert late_line(late, [done]) is None
    assert late_line(replace(summary, lateness_us=Percentiles(60.0, 310.0, 900.0)), [failed]) is None
    seldom = replace(late, lateness_us=Percentiles(2400.0, 8100.0, 12_000.0), ticks=1000, overruns=100)
    assert late_line(seldom, [failed]) is None
    often = late_line(replace(seldom, overruns=600), [failed])
    assert often is not None
    assert "late by up to 12 ms, in 600 ticks by more than a period" in often
    assert late_line(summary, [failed]) is None, "simulated time is never late"


def test_no_task_counts_as_successful_if_links_touched_or_a_stop_was_not_certified_or_a_tool_did_not_follow(
    summary: RunSummary,
) -> None:
    done = TaskResult("stack", True, {}, "")
    pair = ("left_link_6_0", "right_link_6_0")
    torque = TorqueSummary({}, min_measured_distance_mm=0.4, measured_closest_pair=pair, max_wall_force_n=364.0)
    assert held_to_promises([done], replace(summary, torque=torque)) == (done,)
    met = replace(summary, torque=replace(torque, min_measured_distance_mm=-6.9))
    (failed,) = held_to_promises([done], met)
    assert (failed.succeeded, failed.reason) == (False, f"measured {pair[0]} and {pair[1]} met: -6.9 mm")
    assert "measured links met: -6.9 mm, left_link_6_0 | right_link_6_0; what was measured broke" in text_of(met)
    away = replace(summary, arms=summary.arms | {"left": replace(summary.arms["left"], end_error_mm=256.4)})
    assert held_to_promises([done], away)[0].reason == "left arm is 256 mm from its reference at the end"
    (failed,) = held_to_promises([TaskResult("stack", False, {}, "fell")], replace(summary, uncertified_ticks=3))
    assert failed.reason == "fell; 3 ticks without a certificate"


def test_the_summary_names_a_tool_that_did_not_follow_its_reference(summary: RunSummary) -> None:
    assert "did not follow" not in text_of(summary)
    away = replace(summary, arms=summary.arms | {"left": replace(summary.arms["left"], end_error_mm=256.4)})
    assert "256 mm from its reference: the tool did not follow" in text_of(away)


def test_a_run_without_a_live_table_prints_every_ten_seconds_how_much_of_its_time_is_over(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, console = [100.0], Console(file=io.StringIO(), width=80, color_system=None)
    monkeypatch.setattr("q2r2_control.cli.output.time.monotonic", lambda: now[0])
    lines = ProgressLines("demo", 12.8, console)
    for second in range(25):  # The computer is so slow that 0.1 s of the run take a second.
        now[0] = 100.0 + second
        lines(SimpleNamespace(t=0.1 * second))  # type: ignore[arg-type]
    assert isinstance(console.file, io.StringIO)
    assert console.file.getvalue() == "demo: 1.0 of 12.8 s\ndemo: 2.0 of 12.8 s\n"
