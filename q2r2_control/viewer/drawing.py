"""Drawing what changes on a terminal, in a process of its own.

To draw a table keeps Python busy for milliseconds, in which a loop of a kilohertz gets half of its time and misses
ticks. So the process of the loop makes the table only, which takes a tenth of a millisecond, and another one draws it.
"""

from __future__ import annotations

import io
import json
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

_PROGRAM = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from q2r2_control.viewer.drawing import draw_what_comes
draw_what_comes()
"""
# A terminal that takes nothing more, since its user has stopped it, must not keep a run from ending [s].
_PATIENCE = 2.0


@contextmanager
def drawn(make: Callable[[], Table], console: Console, rate: float) -> Iterator[None]:
    """Draw what ``make`` returns on ``console``, ``rate`` times a second [Hz], and leave nothing of it at the end.

    ``make`` is called by a thread. What is printed meanwhile comes above it. A console that is no terminal is left as
    it is. Where the other process cannot begin, or ends too soon, that is one line, and what runs in this context goes
    on.
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
                    if stream.isatty():
                        lines = _Lines(stream, screen.print)
                        stack.callback(lines.end)
                        stack.enter_context(redirect(lines))
        yield


class _Screen:
    """This process's side: what is to be drawn and printed, and the thread that hands it over."""

    def __init__(self, make: Callable[[], Table], console: Console, rate: float) -> None:
        self._make, self._period = make, 1.0 / rate
        self._file = console.file  # as it is before prints are handed over
        self._lines: list[str] = []  # not handed over yet; lists are appended to by any thread
        self._over = threading.Event()
        # Ctrl-C is for the run; a signal that is blocked from the beginning cannot end the other process as it begins.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            arguments = [sys.executable, "-P", "-c", _PROGRAM, json.dumps([*map(str, sys.path)])]
            self._process = subprocess.Popen(
                arguments, stdin=subprocess.PIPE, stdout=self._file, stderr=subprocess.DEVNULL
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._thread = threading.Thread(target=self._hand_over, name="live table", daemon=True)
        self._thread.start()

    def print(self, line: str) -> None:
        """Let a line come above what is drawn."""
        self._lines.append(line)

    def end(self) -> None:
        """Print what is left, wipe the drawing away, and let the other process end."""
        self._over.set()
        self._thread.join(_PATIENCE)
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_PATIENCE)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
            self._thread.join()
            self._show_cursor()
        for line in self._lines:
            self._file.write(f"{line}\n")
        self._file.flush()

    def _hand_over(self) -> None:
        assert self._process.stdin is not None
        try:
            with self._process.stdin as pipe:
                while not self._over.wait(self._period):
                    self._hand_over_lines(pipe)
                    pickle.dump(self._make(), pipe)
                    pipe.flush()
                self._hand_over_lines(pipe)
        except OSError:
            code = self._process.wait()
            how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
            self._show_cursor()
            if not self._over.is_set():
                self._lines.append(f"the process that draws the table has ended {how}; the run goes on without a table")
            self._print_directly()

    def _hand_over_lines(self, pipe: Any) -> None:
        while self._lines:
            pickle.dump(self._lines[0], pipe)
            pipe.flush()
            del self._lines[0]  # after it, so that a line that was not taken is not lost

    def _show_cursor(self) -> None:
        """Which a process that was ended has left hidden."""
        self._file.write(str(Control.show_cursor(True)))
        self._file.flush()

    def _print_directly(self) -> None:
        """As long as the run goes on, where nothing is drawn any more."""
        while not self._over.wait(self._period):
            while self._lines:
                self._file.write(f"{self._lines.pop(0)}\n")
            self._file.flush()


class _Lines(io.TextIOBase):
    """Takes the place of a terminal's stream, whose whole lines it hands over."""

    def __init__(self, stream: TextIO, take: Callable[[str], None]) -> None:
        self._stream, self._take, self._rest, self._lock = stream, take, "", threading.Lock()

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
                self._take(line)
        return len(text)

    def end(self) -> None:
        """Hand over what is no whole line yet."""
        if self._rest:
            self.write("\n")


def draw_what_comes() -> None:
    """The other process's side: draw and print what comes on standard input, until it ends."""
    console = Console()
    with (
        suppress(EOFError, pickle.UnpicklingError),  # the run has ended, whether it said so or was killed
        Live(console=console, auto_refresh=False, transient=True, redirect_stdout=False, redirect_stderr=False) as live,
    ):
        while True:
            shown = pickle.load(sys.stdin.buffer)
            if isinstance(shown, str):
                console.print(Text.from_ansi(shown), soft_wrap=True)
            else:
                live.update(shown, refresh=True)
