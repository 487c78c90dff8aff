"""Drawing what changes on a terminal, in a process of its own.

To draw a table keeps Python busy for milliseconds, in which a loop of a kilohertz gets half of its time and misses
ticks. So the process of the loop makes the table only, which takes a fraction of a millisecond, and another one draws
it. All that waits for the terminal is done by that process, or by a thread that nothing waits for.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any, TextIO

from rich.console import Console
from rich.control import Control
from rich.live import Live
from rich.table import Table
from rich.text import Text

from q2r2_control.process.signals import how_it_ended

_PROGRAM = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from q2r2_control.viewer.drawing import draw_what_comes
draw_what_comes(int(sys.argv[2]))
"""
# The other process ends with the run, whatever ends that; a signal that is blocked from its first moment cannot end it
# sooner, as Ctrl-C would, which a terminal sends to all.
_FOR_THE_RUN = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
# A terminal that its user has stopped takes nothing more, and must not keep a run from ending [s].
_PATIENCE = 2.0
_STARTING = 6.0  # times as long, before the other process has begun
_SHOWN, _FAILED = b".", b"!"  # what the other process says of what it was given; the latter with the reason


@contextmanager
def drawn(make: Callable[[], Table], console: Console, rate: float) -> Iterator[None]:
    """Draw what ``make`` returns on ``console``, ``rate`` times a second [Hz], and leave nothing of it at the end.

    ``make`` is called by a thread. What is printed meanwhile comes above it. A console that is no terminal is left as
    it is. Where there can be no table, or not any more, that is one line, and what runs in this context goes on.
    """
    with ExitStack() as stack:
        if console.is_terminal:
            try:
                screen = _Screen(make, console, rate)
            except OSError as error:
                console.print(f"no live table: {error}", soft_wrap=True, highlight=False, markup=False)
            else:
                stack.callback(screen.end)
                for redirect, stream in ((redirect_stdout, sys.stdout), (redirect_stderr, sys.stderr)):
                    if stream is not None and stream.isatty():
                        lines = _Lines(stream, screen.print)
                        stack.callback(lines.end)
                        stack.enter_context(redirect(lines))
        yield


class _Screen:
    """This process's side: what is to be drawn and printed, and the thread that hands it over."""

    def __init__(self, make: Callable[[], Table], console: Console, rate: float) -> None:
        self._make, self._period = make, 1.0 / rate
        self._file = console.file  # as it is before prints are handed over
        self._lines: list[str] = []  # not handed over yet; any thread appends
        self._given: list[str] = []  # handed over, and not known to be shown
        self._over = threading.Event()
        self._answers, answers = os.pipe()
        os.set_blocking(self._answers, False)
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _FOR_THE_RUN)
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _PROGRAM, json.dumps([*map(str, sys.path)]), str(answers)],
                stdin=subprocess.PIPE,
                stdout=self._file,
                stderr=subprocess.DEVNULL,
                pass_fds=(answers,),
            )
        except OSError:
            os.close(self._answers)
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            os.close(answers)
        self._begun, self._reason = False, ""
        self._thread = threading.Thread(target=self._work, name="live table", daemon=True)
        self._thread.start()

    def print(self, line: str) -> None:
        """Let a line come above what is drawn."""
        self._lines.append(line)

    def end(self) -> None:
        """Print what is left, wipe the drawing away, and let the other process end."""
        self._over.set()
        self._thread.join(_PATIENCE)
        if self._thread.is_alive() and not self._begun:
            self._thread.join(_STARTING * _PATIENCE)
        if self._thread.is_alive():
            self._process.kill()
            self._thread.join(_PATIENCE)  # it prints what is left, if the terminal takes it

    def _work(self) -> None:
        problem = self._hand_over()
        self._process.wait()
        self._listen()
        os.close(self._answers)
        code = self._process.returncode
        if code and problem is None and not self._over.is_set():
            problem = self._reason or how_it_ended("the process that draws it", code)
        with suppress(OSError):  # the terminal is gone
            if code:
                self._file.write(str(Control.show_cursor(True)))  # which the other process has left hidden
            if problem is not None:
                self._file.write(f"no live table any more: {problem}\n")
            self._lines[:0] = self._given
            ends = False
            while not ends:
                ends = self._over.wait(self._period)  # before the last look
                while self._lines:
                    self._file.write(f"{self._lines.pop(0)}\n")
                self._file.flush()

    def _hand_over(self) -> str | None:
        """Until the run is over or no table can be drawn any more; returns why that is, where it is known."""
        assert self._process.stdin is not None
        try:
            with self._process.stdin as pipe:
                while not self._over.wait(self._period):
                    self._listen()
                    while self._lines:
                        self._given.append(self._lines.pop(0))
                        pickle.dump(self._given[-1], pipe)
                    pickle.dump(self._make(), pipe)
                    pipe.flush()
        except OSError:
            return None  # the other process has ended
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        return None

    def _listen(self) -> None:
        """Take what the other process has said."""
        with suppress(BlockingIOError):
            while said := os.read(self._answers, 4096):
                shown, _, reason = said.partition(_FAILED)
                if shown:
                    del self._given[: len(shown) - (not self._begun)]  # the first one is for its begin
                    self._begun = True
                self._reason += reason.decode(errors="replace")


class _Lines(io.TextIOBase):
    """Takes the place of a terminal's stream, whose whole lines it hands over."""

    def __init__(self, stream: TextIO, take: Callable[[str], object]) -> None:
        self._stream, self._take, self._rest = stream, take, ""
        self._lock = threading.RLock()  # what prints may be interrupted by what prints

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return self._stream.encoding

    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._stream.fileno()

    def write(self, text: str) -> int:
        with self._lock:
            *lines, self._rest = (self._rest + text).split("\n")
            for line in lines:
                self._take(line.rstrip("\r"))
        return len(text)

    def end(self) -> None:
        """Hand over what is no whole line yet; what is still written here then goes to the stream."""
        if self._rest:
            self.write("\n")
        self._take = lambda line: self._stream.write(f"{line}\n")


def draw_what_comes(answers: int) -> None:
    """The other process's side: draw and print what comes on standard input, until it ends.

    Tells the pipe ``answers`` that it has begun, of each line that was printed, and why it ends before.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    console = Console()
    os.write(answers, _SHOWN)
    try:
        with Live(
            console=console, auto_refresh=False, transient=True, redirect_stdout=False, redirect_stderr=False
        ) as live:
            while True:
                shown: Any = pickle.load(sys.stdin.buffer)
                if isinstance(shown, str):
                    console.print(Text.from_ansi(shown), soft_wrap=True)
                    os.write(answers, _SHOWN)
                else:
                    live.update(shown, refresh=True)
    except (EOFError, pickle.UnpicklingError):
        pass  # the run has ended, whether it said so or was killed
    except Exception as error:
        with suppress(OSError):  # nobody listens any more
            os.write(answers, _FAILED + f"{type(error).__name__}: {error}".encode()[:1000])
        raise
