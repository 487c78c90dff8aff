"""What is drawn by another process, on a real terminal: a pair of a pseudo-terminal."""

from __future__ import annotations

import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, redirect_stderr
from typing import Any, TextIO

import pytest
from rich.console import Console
from rich.table import Table

from q2r2_control.viewer import drawing
from q2r2_control.viewer.drawing import drawn

_DEADLINE = 60.0  # a machine may be slow [s]


class Terminal:
    """What this process writes its errors to, and what has come out of it."""

    def __init__(self, reads: int, file: TextIO) -> None:
        self._reads, self.file, self.text = reads, file, ""

    def read_until(self, expected: str) -> str:
        """All that came before it, and since the last one that was waited for."""
        end = time.monotonic() + _DEADLINE
        while expected not in self.text:
            assert time.monotonic() < end, f"{expected!r} did not come; {self.text!r} did"
            if select.select([self._reads], [], [], 0.1)[0]:
                self.text += os.read(self._reads, 65536).decode()
        before, _, self.text = self.text.partition(expected)
        return before


@contextmanager
def a_terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    """Within a test, since pytest gives its parts streams of its own."""
    monkeypatch.setenv("TERM", "xterm")
    reads, writes = pty.openpty()
    with open(writes, "w", encoding="utf-8") as file, redirect_stderr(file):
        yield Terminal(reads, file)
    os.close(reads)


class Counting:
    """A table whose only row says how often it was made."""

    def __init__(self) -> None:
        self.made = 0

    def __call__(self) -> Table:
        self.made += 1
        table = Table("made")
        table.add_row(f"{self.made} times.")
        return table


def started(monkeypatch: pytest.MonkeyPatch) -> list[subprocess.Popen[bytes]]:
    """The processes that are started from now on."""
    found: list[subprocess.Popen[bytes]] = []

    class Noted(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            found.append(self)

    monkeypatch.setattr(drawing.subprocess, "Popen", Noted)
    return found


def test_a_table_is_drawn_again_and_again_and_wiped_away_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_terminal(monkeypatch) as terminal:
        processes = started(monkeypatch)
        with drawn(Counting(), Console(stderr=True), 50.0):
            terminal.read_until("1 times.")
            terminal.read_until("3 times.")
            assert processes[0].poll() is None
        assert processes[0].returncode == 0
        print("the end", file=sys.stderr, flush=True)
        assert "\x1b[2K" in terminal.read_until("the end"), "lines are cleared"


def test_what_is_printed_comes_above_the_table_whole_and_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_terminal(monkeypatch) as terminal:
        with drawn(Counting(), Console(stderr=True), 50.0):
            terminal.read_until("1 times.")
            print("in two ", end="", file=sys.stderr)
            print("parts", file=sys.stderr)
            Console(stderr=True).print("[red]coloured[/]")
            print("no whole line", end="", file=sys.stderr)
            terminal.read_until("in two parts")
            terminal.read_until("\x1b[31mcoloured")
        terminal.read_until("no whole line")
        assert sys.stderr is terminal.file


def test_ctrl_c_is_for_the_run_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_terminal(monkeypatch) as terminal:
        processes = started(monkeypatch)
        with drawn(Counting(), Console(stderr=True), 50.0):
            processes[0].send_signal(signal.SIGINT)  # before it has begun
            terminal.read_until("1 times.")
            processes[0].send_signal(signal.SIGINT)
            terminal.read_until("3 times.")
        assert processes[0].returncode == 0


def test_a_drawing_process_that_is_killed_is_a_line_and_nothing_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_terminal(monkeypatch) as terminal:
        processes = started(monkeypatch)
        with drawn(Counting(), Console(stderr=True), 50.0):
            terminal.read_until("1 times.")
            processes[0].kill()
            terminal.read_until("\x1b[?25h")  # the cursor is there again
            terminal.read_until("ended by SIGKILL; the run goes on without a table")
            print("first", file=sys.stderr)
            terminal.read_until("first")
            print("last", file=sys.stderr)
        terminal.read_until("last")


def test_one_that_cannot_begin_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_terminal(monkeypatch) as terminal:
        monkeypatch.setattr(sys, "executable", "/no/such/python")
        with drawn(Counting(), Console(stderr=True), 50.0):
            terminal.read_until("no live table: ")
            assert sys.stderr is terminal.file


def test_a_terminal_that_is_stopped_keeps_nothing_from_ending(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_terminal(monkeypatch) as terminal:
        processes = started(monkeypatch)
        monkeypatch.setattr(drawing, "_PATIENCE", 0.1)
        with drawn(Counting(), Console(stderr=True), 1000.0):
            terminal.read_until("1 times.")
            processes[0].send_signal(signal.SIGSTOP)
        assert processes[0].returncode == -signal.SIGKILL


def test_a_fault_in_the_run_ends_the_drawing_and_leaves_the_streams_as_they_were(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with a_terminal(monkeypatch) as terminal:
        processes = started(monkeypatch)
        with pytest.raises(RuntimeError), drawn(Counting(), Console(stderr=True), 50.0):
            raise RuntimeError
        assert processes[0].returncode == 0
        assert sys.stderr is terminal.file


def test_a_console_that_is_no_terminal_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    processes = started(monkeypatch)
    counting, console = Counting(), Console(file=open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    with closing(console.file), drawn(counting, console, 1000.0):
        pass
    assert not processes
    assert counting.made == 0
