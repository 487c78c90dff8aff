"""Drawing what changes on a terminal, by a thread that nothing waits for."""

from __future__ import annotations

import io
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import IO, TextIO

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

# A terminal that its user has stopped takes nothing more, and must not keep a run from ending [s].
_PATIENCE = 2.0
# Drawing takes milliseconds of Python at a time. The loop gets the interpreter back within this time, as it has to
# after each kernel of a tick [s].
_SWITCH_INTERVAL = 2e-5


@contextmanager
def drawn(make: Callable[[], Table], console: Console, rate: float) -> Iterator[None]:
    """Draw what ``make`` returns on ``console``, ``rate`` times a second [Hz], and leave nothing of it at the end.

    A thread calls ``make``. What is printed meanwhile comes above the table. A console that is no terminal is left as
    it is. Where no table can be drawn any more, that is one line, and what runs in this context goes on.
    """
    with ExitStack() as stack:
        if console.is_terminal and console.file.isatty():
            screen = _Screen(make, console.file, rate)
            stack.callback(screen.end)
            for redirect, stream in ((redirect_stdout, sys.stdout), (redirect_stderr, sys.stderr)):
                if stream is not None and stream.isatty():
                    lines = _Lines(stream, screen.print)
                    stack.callback(lines.end)
                    stack.enter_context(redirect(lines))
        yield


class _Screen:
    """What is to be drawn and printed, and the thread that does both."""

    def __init__(self, make: Callable[[], Table], terminal: IO[str], rate: float) -> None:
        self._make, self._period = make, 1.0 / rate
        # A file of its own: the interpreter does not wait for its lock at exit where the terminal takes nothing.
        self._file = open(  # noqa: SIM115
            os.dup(terminal.fileno()), "w", encoding="utf-8", errors="backslashreplace"
        )
        self._lines: deque[str] = deque()  # not printed yet; any thread appends
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="live table", daemon=True)
        self._thread.start()

    def print(self, line: str) -> None:
        """Let a line come above what is drawn."""
        self._lines.append(line)

    def end(self) -> None:
        """Print what is left and wipe the drawing away, if the terminal takes it."""
        self._over.set()
        self._thread.join(_PATIENCE)

    def _work(self) -> None:
        before = sys.getswitchinterval()
        sys.setswitchinterval(min(before, _SWITCH_INTERVAL))
        try:
            self._draw()
        except Exception as error:
            self._lines.appendleft(f"no live table any more: {type(error).__name__}: {error}")
            self._print_only()
        finally:
            sys.setswitchinterval(before)
            with suppress(OSError):  # the terminal is gone
                self._file.close()

    def _draw(self) -> None:
        console = Console(file=self._file)
        with Live(
            console=console, auto_refresh=False, transient=True, redirect_stdout=False, redirect_stderr=False
        ) as live:
            ends = False
            while not ends:
                ends = self._over.wait(self._period)  # before the last look at the lines
                while self._lines:
                    console.print(Text.from_ansi(self._lines[0]), soft_wrap=True)
                    self._lines.popleft()
                if not ends:
                    live.update(self._make(), refresh=True)

    def _print_only(self) -> None:
        with suppress(OSError):  # the terminal is gone
            ends = False
            while not ends:
                ends = self._over.wait(self._period)
                while self._lines:
                    self._file.write(f"{self._lines.popleft()}\n")
                self._file.flush()


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
