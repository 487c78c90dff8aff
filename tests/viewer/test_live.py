"""The live table: what it shows, and how it is drawn on a real terminal, one end of a pseudo-terminal."""

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
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ActiveLimit, LimitKind
from q2r2_control.viewer.live import LiveTable
from tests.viewer.ticks import tick_at

JOINTS = {side: [f"{side}_A{number}" for number in range(1, 8)] for side in ("left", "right")}


def drawn(table: LiveTable) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(table.render())
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_it_shows_states_errors_distances_and_grippers_of_the_newest_tick(robot: Robot) -> None:
    table = LiveTable("demo", JOINTS, BindingSettings())
    table(tick_at(robot, 1.0, engaged=False))
    table(tick_at(robot, 2.0, distance=0.0234))
    text = drawn(table)
    for expected in ("demo", "engaged", "3.0 mm", "5.73 deg", "50 %", "23.4 mm", "left_hand_0 | table_0", "2.0 s"):
        assert expected in text
    assert "5.4 mm to spare" in text
    assert "left_link_5_0 | right_link_5_0" in text
    assert "paused" not in text


def test_it_names_what_holds_a_gripper(robot: Robot) -> None:
    table = LiveTable("demo", JOINTS, BindingSettings())
    table(replace(tick_at(robot, 1.0), held_grippers={"left": ("left_finger_0", "block_0")}))
    assert "left_finger_0 | block_0" in drawn(table)


def test_it_shows_every_limit_that_was_at_work_since_it_was_drawn_last(robot: Robot) -> None:
    table = LiveTable("demo", JOINTS, BindingSettings())
    tick = tick_at(robot, 0.0)
    report = replace(tick.reference.report, binding=(ActiveLimit(LimitKind.VELOCITY, ("left_A2",)),))
    table(replace(tick, reference=replace(tick.reference, report=report)))
    table(tick)
    assert "left_A2 velocity" in drawn(table)
    assert "left_A2 velocity" not in drawn(table)


def test_before_the_first_tick_it_says_that_the_run_is_starting() -> None:
    assert "starting" in drawn(LiveTable("demo", JOINTS, BindingSettings()))


class Terminal:
    """A terminal, and what has come out of it, which a thread reads."""

    def __init__(self) -> None:
        self._reads, writes = pty.openpty()
        self.file, self.text = open(writes, "w", encoding="utf-8"), ""  # noqa: SIM115
        threading.Thread(target=self._read, daemon=True).start()

    def wait_for(self, expected: str) -> None:
        end = time.monotonic() + 60.0  # a machine may be slow
        while expected not in self.text:
            assert time.monotonic() < end, f"{expected!r} did not come; {self.text!r} did"
            time.sleep(0.01)

    def _read(self) -> None:
        with suppress(OSError):  # when the test is over
            while data := os.read(self._reads, 4096):
                self.text += data.decode(errors="replace")


def test_it_is_drawn_again_and_again_below_what_is_printed_and_wiped_away_at_the_end(
    monkeypatch: pytest.MonkeyPatch, robot: Robot
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    table, terminal = LiveTable("demo", JOINTS, BindingSettings()), Terminal()
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


def test_a_console_that_is_no_terminal_is_left_alone() -> None:
    console = Console(file=io.StringIO())
    with LiveTable("demo", JOINTS, BindingSettings()).shown(console):
        pass
    assert isinstance(console.file, io.StringIO)
    assert not console.file.getvalue()
