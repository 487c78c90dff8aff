"""What a thread draws on a real terminal: a pair of a pseudo-terminal."""

from __future__ import annotations

import codecs
import os
import pty
import sys
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, redirect_stderr, suppress
from typing import TextIO

import pytest
from rich.console import Console
from rich.table import Table

from q2r2_control.viewer import drawing
from q2r2_control.viewer.drawing import drawn

_DEADLINE = 60.0  # a machine may be slow [s]


class Terminal:
    """What this process writes its errors to, and what has come out of it, which a thread reads."""

    def __init__(self, reads: int, file: TextIO) -> None:
        self.reads, self.file, self.text = reads, file, ""
        self._decoder = codecs.getincrementaldecoder("utf-8")()
        threading.Thread(target=self._read, daemon=True).start()

    def read_until(self, expected: str) -> str:
        """All that came before it, and since the last one that was waited for."""
        end = time.monotonic() + _DEADLINE
        while expected not in self.text:
            assert time.monotonic() < end, f"{expected!r} did not come; {self.text!r} did"
            time.sleep(0.01)
        before, _, self.text = self.text.partition(expected)
        return before

    def _read(self) -> None:
        with suppress(OSError):  # when the test is over
            while data := os.read(self.reads, 4096):
                self.text += self._decoder.decode(data)


@contextmanager
def a_terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    """Within a test, since pytest gives its parts streams of its own."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(drawing, "_PATIENCE", _DEADLINE)  # nothing depends on how busy the machine is
    reads, writes = pty.openpty()
    with open(writes, "w", encoding="utf-8") as file, redirect_stderr(file):
        yield Terminal(reads, file)


class Counting:
    """A table whose only row says how often it was made."""

    def __init__(self) -> None:
        self.made = 0

    def __call__(self) -> Table:
        self.made += 1
        table = Table("made")
        table.add_row(f"{self.made} times.")
        return table


def test_a_table_is_drawn_again_and_again_and_wiped_away_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_terminal(monkeypatch) as terminal:
        with drawn(Counting(), Console(stderr=True), 50.0):
            terminal.read_until("1 times.")
            terminal.read_until("3 times.")
        print("the end", file=sys.stderr, flush=True)
        last = terminal.read_until("the end").rpartition("times.")[2]
        assert last.count("\x1b[2K") >= 5, "all lines are cleared after the last drawing"


def test_what_is_printed_comes_above_the_table_whole_and_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_terminal(monkeypatch) as terminal:
        with drawn(Counting(), Console(stderr=True), 50.0):
            terminal.read_until("1 times.")
            print("in two ", end="", file=sys.stderr)
            print("parts\r", file=sys.stderr)
            Console(stderr=True).print("[red]coloured[/]")
            print("x" * 200, file=sys.stderr)
            print("no whole line", end="", file=sys.stderr)
            terminal.read_until("in two parts")
            terminal.read_until("\x1b[31mcoloured")
            terminal.read_until("x" * 200)
        terminal.read_until("no whole line")
        assert sys.stderr is terminal.file


def test_a_table_that_cannot_be_made_is_a_line_and_what_is_printed_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    counting = Counting()

    def make() -> Table:
        if counting.made == 3:
            raise ValueError("three")
        return counting()

    with a_terminal(monkeypatch) as terminal, drawn(make, Console(stderr=True), 50.0):
        terminal.read_until("no live table any more: ValueError: three")
        print("arms stopped", file=sys.stderr)
        terminal.read_until("arms stopped")


def test_a_terminal_that_its_user_has_stopped_keeps_no_run_from_ending(monkeypatch: pytest.MonkeyPatch) -> None:
    with a_terminal(monkeypatch) as terminal:
        with drawn(Counting(), Console(stderr=True), 1000.0):
            terminal.read_until("1 times.")
            monkeypatch.setattr(drawing, "_PATIENCE", 0.2)
            termios.tcflow(terminal.file.fileno(), termios.TCOOFF)
            print("later", file=sys.stderr)
        termios.tcflow(terminal.file.fileno(), termios.TCOON)
        terminal.read_until("later")


def test_a_fault_in_the_run_ends_the_drawing_and_leaves_the_streams_as_they_were(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with a_terminal(monkeypatch) as terminal:
        kept = []

        def fail() -> None:
            with drawn(Counting(), Console(stderr=True), 50.0):
                kept.append(sys.stderr)
                raise RuntimeError

        with pytest.raises(RuntimeError):
            fail()
        assert sys.stderr is terminal.file
        print("afterwards", file=kept[0], flush=True)
        terminal.file.flush()
        terminal.read_until("afterwards")


def test_what_prints_while_it_is_interrupted_by_what_prints_goes_on() -> None:
    taken: list[str] = []

    def take(line: str) -> None:
        taken.append(line)
        if line == "first":
            lines.write("second\n")  # as a signal's handler or a finalizer may

    lines = drawing._Lines(sys.stderr, take)
    writer = threading.Thread(target=lines.write, args=("first\nthird\n",), daemon=True)
    writer.start()
    writer.join(_DEADLINE)
    assert taken == ["first", "second", "third"]


def test_a_console_that_is_no_terminal_is_left_alone() -> None:
    counting, console = Counting(), Console(file=open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    with closing(console.file), drawn(counting, console, 1000.0):
        pass
    assert counting.made == 0
