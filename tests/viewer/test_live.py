"""The live table: its contents, and how it is drawn on a terminal. The terminal is one end of a pseudo-terminal."""

from __future__ import annotations

import io
import os
import pty
import sys
import threading
import time
from contextlib import redirect_stderr, suppress
from dataclasses import replace

import pytest
from rich.console import Console

from q2r2_control.config.bindings import BindingSettings
from q2r2_control.events import Event, Reason
from q2r2_control.robot.robot import Robot
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import ActiveLimit, LimitKind
from q2r2_control.viewer.arm_words import ArmWords
from q2r2_control.viewer.episode_words import EpisodeWords
from q2r2_control.viewer.live import LiveTable
from tests.cli.test_output import printed
from tests.viewer.conftest import tick_at

JOINTS = {side: [f"{side}_A{number}" for number in range(1, 8)] for side in ("left", "right")}


def test_the_table_shows_states_errors_distances_and_grippers_of_the_newest_tick(robot: Robot) -> None:
    table = LiveTable("demo", ArmWords(JOINTS, BindingSettings()))
    table(tick_at(robot, 1.0, engaged=False))
    table(replace(tick_at(robot, 2.0, distance=0.0234), held_grippers={"left": ("left_finger_0", "block_0")}))
    text = printed(table.render(120), 120)
    for expected in (
        *("demo", "engaged", "3.0 mm", "5.73 deg", "50 %", "23.4 mm", "left_hand_0 | table_0", "2.0 s"),
        *("5.4 mm to spare", "left_link_5_0 | right_link_5_0", "left_finger_0 | block_0"),
    ):
        assert expected in text
    assert "paused" not in text


def test_the_table_shows_the_episode_and_the_subtask_that_are_recorded(robot: Robot) -> None:
    words = ArmWords(JOINTS, BindingSettings())
    table = LiveTable("demo", words, episodes=EpisodeWords(("reach", "grasp [the] cube")))
    begun = (Reason(TeleopReason.EPISODE_BEGINS), Reason.of(TeleopReason.SUBTASK_BEGINS, number=2, name="grasp"))
    told = [Event(1.0, "left", "paused", "paused", reason) for reason in begun]
    table(replace(tick_at(robot, 1.0), events=told))
    assert "records episode 1, subtask 2: grasp [the] cube" in printed(table.render(160), 160)


def test_the_table_cuts_off_no_name_and_no_progress_in_80_columns(robot: Robot) -> None:
    table = LiveTable("demo", ArmWords(JOINTS, BindingSettings()), ((0.0, "meet: both grasp"),), 10.0)
    tick = tick_at(robot, 2.5)
    pair = ("right_hand_e_finger_1_envelope_0", "left_hand_e_finger_1_envelope_0")
    report = replace(tick.reference.report, closest_pair=pair)
    table(replace(tick, reference=replace(tick.reference, report=report)))
    assert "…" not in printed(table.render(80), 80)


@pytest.mark.parametrize("columns", [80, 200])
def test_the_columns_keep_their_widths_as_their_texts_change(columns: int, robot: Robot) -> None:
    table, tick = LiveTable("demo", ArmWords(JOINTS, BindingSettings())), tick_at(robot, 2.5)
    widths = set()
    for pair in (("a", "b"), ("right_hand_e_finger_1_envelope_0", "left_hand_e_finger_1_envelope_0")):
        report = replace(tick.reference.report, closest_pair=pair)
        table(replace(tick, reference=replace(tick.reference, report=report)))
        console = Console(file=(file := io.StringIO()), width=columns)
        console.print(table.render(columns))
        heading = next(line for line in file.getvalue().splitlines() if "left" in line)
        widths.add(tuple(index for index, letter in enumerate(heading) if letter == "┃"))
    assert len(widths) == 1, "a table whose columns jump is hard to read"


def test_the_table_shows_each_arm_s_session_with_its_cabinet(robot: Robot) -> None:
    table = LiveTable("demo", ArmWords(JOINTS, BindingSettings()))
    sessions = {"left": "commanding active, connection good, drives active", "right": "not heard"}
    table(replace(tick_at(robot, 0.0), sessions=sessions))
    text = printed(table.render(160), 160)
    assert "not heard" in text
    assert sessions["left"] in text


def test_the_table_shows_the_step_of_the_work_and_how_much_of_the_work_is_done(robot: Robot) -> None:
    steps = ((0.0, "stack: the left hand reaches for a block"), (2.0, "stack: it grasps"), (3.0, "stack: it lifts"))
    table = LiveTable("demo", ArmWords(JOINTS, BindingSettings()), steps, 10.0)
    table(tick_at(robot, 2.5))
    text = printed(table.render(120), 120)
    assert "stack: it grasps" in text
    assert "━" * 5 + "·" * 15 + " 25%" in text


def test_the_table_shows_every_limit_that_was_active_since_the_table_was_last_drawn(robot: Robot) -> None:
    table = LiveTable("demo", ArmWords(JOINTS, BindingSettings()))
    tick = tick_at(robot, 0.0)
    report = replace(tick.reference.report, binding=(ActiveLimit(LimitKind.VELOCITY, ("left_A2",)),))
    table(replace(tick, reference=replace(tick.reference, report=report)))
    table(tick)
    assert "left_A2 velocity" in printed(table.render(120), 120)
    assert "left_A2 velocity" not in printed(table.render(120), 120)


class Terminal:
    """A terminal and its output, which a thread reads."""

    def __init__(self) -> None:
        self._reads, writes = pty.openpty()
        self.file, self.text = open(writes, "w", encoding="utf-8"), ""  # noqa: SIM115
        threading.Thread(target=self._read, daemon=True).start()

    def wait_for(self, expected: str) -> None:
        end = time.monotonic() + 60.0  # This timeout is long, because a machine may be slow.
        while expected not in self.text:
            assert time.monotonic() < end, f"{expected!r} did not come; {self.text!r} did"
            time.sleep(0.01)

    def _read(self) -> None:
        with suppress(OSError):  # The terminal closes when the test is over.
            while data := os.read(self._reads, 4096):
                self.text += data.decode(errors="replace")


def test_the_table_is_redrawn_below_printed_lines_and_removed_at_the_end(
    monkeypatch: pytest.MonkeyPatch, robot: Robot
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    table, terminal = LiveTable("demo", ArmWords(JOINTS, BindingSettings())), Terminal()
    with redirect_stderr(terminal.file):
        with table.shown(Console(stderr=True)):
            terminal.wait_for("starting")
            table(tick_at(robot, 4.0))
            terminal.wait_for("4.0 s")
            print("arms stopped", file=sys.stderr)
            terminal.wait_for("arms stopped")
            before = len(terminal.text)
            table(replace(tick_at(robot, 5.0), states={}))
            terminal.wait_for("no live table: KeyError")
        assert sys.stderr is terminal.file
        print("the end", file=sys.stderr, flush=True)
        terminal.wait_for("the end")
    assert "\x1b[2K" in terminal.text[before:], "lines are cleared"
