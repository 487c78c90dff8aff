"""The output of commands: JSON on stdout, lines about a run, tables, and messages on stderr."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

from pydantic_core import to_json
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table
from typer import Argument, Option

from q2r2_control.config.cell import Config
from q2r2_control.control.jit import compiling
from q2r2_control.control.solvers.registry import check_installed
from q2r2_control.errors import ConfigError
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.viewer.tables import print_table

if TYPE_CHECKING:
    from q2r2_control.demo.assembly_tasks import TaskResult
    from q2r2_control.judging.judge import Verdict
    from q2r2_control.recording.recorder import RecordingSummary

# A late loop may be the reason why a task failed. A loop counts as late if one tick was late by at least _LATE [us], or
# if the share of ticks that were late by more than a period is larger than _OFTEN.
_LATE, _OFTEN = 2e4, 0.2
# Time until the first line about the compilation of kernels, and time between two such lines [s].
_SILENT_S, _BETWEEN_LINES_S = 3.0, 5.0
_BETWEEN_TIMES_S = 10.0  # Time between two lines about how much of a run is over [s].
SCRIPTS_WAIT_S = 60.0  # Longest wait for cabinets if no person at a terminal can end the wait.
DEMO_CONFIG = "config/dual_iiwa7.yaml"

ConfigFile = Annotated[str, Argument(metavar="CONFIG", help="The cell's YAML, such as config/dual_iiwa7.yaml.")]
RealTime = Annotated[bool, Option("--rt", help="Lock memory and use SCHED_FIFO, as far as permitted.")]
WebHost = Annotated[str, Option(metavar="HOST", help="Address of the page; beyond 127.0.0.1: HTTPS and a token.")]
WebPort = Annotated[int, Option(min=0, max=65535, metavar="PORT", help="Port of the page; 0: any free one.")]
Wait = Annotated[
    float | None,
    Option(
        min=0, metavar="SECONDS", help="Longest wait for KUKA's cabinets; by default 60, or without end at a terminal."
    ),
]
Verbose = Annotated[bool, Option("--verbose", help="Print all figures of the summary, not only those of the result.")]
Json = Annotated[bool, Option("--json", help="Print one JSON object on stdout, and everything else on stderr.")]
Task = Annotated[str | None, Option(help="With --record: the task in words, which the recording keeps.")]
Solver = Annotated[
    str | None,
    Option(metavar="NAME", help="QP solver, instead of control.solver: daqp, osqp, or another installed one."),
]
Anonymous = Annotated[
    bool, Option("--anonymous", help="Leave out the names of the operator and of the recording computer.")
]
Workers = Annotated[int, Option(min=1, help="Number of processes. It does not change the result.")]
ClusterAddress = Annotated[
    str | None,
    Option(
        "--cluster",
        metavar="ADDRESS",
        help="Address or file of a dask scheduler, whose workers do the work; needs the extra `cluster`.",
    ),
]
Operator = Annotated[str | None, Option(help="With --record: the operator's name, which the recording keeps.")]


def as_json_text(value: Any) -> str:
    """Return ``value`` as strict JSON: dataclasses and mappings as objects, arrays as lists, inf and nan as null."""
    return to_json(value, inf_nan_mode="null", fallback=lambda array: array.tolist()).decode()


def with_solver(config: Config, name: str | None) -> Config:
    """Return the cell with the QP solver ``name``. If it is None, the cell keeps its own solver.

    Raises :class:`ConfigError` if the solver is not installed.
    """
    if name is not None:
        check_installed(name)
    return config.model_copy(update={"control": config.control.with_solver(name)})


def print_report(data: Any, tables: Iterable[Table], json: bool) -> None:
    """Print a command's result on stdout: ``data`` as one JSON object, or the ``tables``."""
    if json:
        print(as_json_text(data))
        return
    console = Console()
    for table in tables:
        print_table(table, console)


def say(line: str, console: Console | None = None, style: str = "") -> None:
    """Print one line without wrapping it, on stderr or ``console``."""
    (console or Console(stderr=True)).print(line, style=style, soft_wrap=True, highlight=False, markup=False)


@contextmanager
def counting(what: str = "") -> Iterator[Callable[[str, int, int], None]]:
    """Show the progress of long work: as a bar if stderr is a terminal, otherwise as a line every few seconds.

    The yielded function takes a text, the number of finished items, and the number of all items.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        due = time.monotonic() + _BETWEEN_LINES_S

        def tell(of: str, done: int, total: int) -> None:
            nonlocal due
            if time.monotonic() >= due:
                due = time.monotonic() + _BETWEEN_LINES_S
                say(f"{of or what}: {done} of {total}", console)

        yield tell
        return
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task(what, total=None)
        yield lambda of, done, total: progress.update(task, description=of or what, completed=done, total=total)


def print_progress(what: str) -> None:
    """Print a line on stderr if stderr is a terminal.

    No live progress bar is used, because its thread would distort the measured times.
    """
    console = Console(stderr=True)
    if console.is_terminal:
        console.print(what, highlight=False)


class _CompilingLines:
    """Prints the progress of compiling the controller's kernels, one line every few seconds."""

    def __init__(self) -> None:
        self._start: float | None = None
        self._due = 0.0

    def __call__(self, done: int, total: int) -> None:
        """Print a line if it is due. The line has the remaining time, estimated as if all kernels took equally long."""
        now = time.monotonic()
        if self._start is None:
            self._start, self._due = now, now + _SILENT_S
        if now < self._due or done == 0:
            return
        self._due = now + _BETWEEN_LINES_S
        to_go = (now - self._start) / done * (total - done)
        say(f"compiling {done} of {total} kernels, once for each version of the code; about {to_go:.0f} s to go")


@contextmanager
def notice_of_compiling() -> Iterator[None]:
    """Print the reason for the wait if compiling the controller's kernels takes longer than three seconds."""
    with compiling(_CompilingLines()):
        yield


def notes_of(task: str | None, operator: str | None, record: object, anonymous: bool) -> dict[str, str]:
    """Return the notes for a recording, by name: the ``task`` and the ``operator`` unless they are None.

    Raises :class:`ConfigError` if a note is empty, or if a note or ``anonymous`` is given although nothing is recorded.
    """
    if anonymous and record is None:
        raise ConfigError("--anonymous needs --record")
    notes = {name: text for name, text in (("task", task), ("operator", operator)) if text is not None}
    for name in notes:
        if record is None:
            raise ConfigError(f"--{name} needs --record")
        if not notes[name].strip():
            raise ConfigError(f"--{name} is empty; allowed: some words, or no --{name}")
    return notes


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """Return a text with ``number`` and ``noun``. Unless the number is 1, the noun is the ``plural``, or gets an s."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def positive(option: str, value: float | None) -> float | None:
    """Return the ``value`` [s] that the user gave to ``option``; None if the user gave none.

    Raises :class:`ConfigError` if the value is not positive and finite.
    """
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"{option} {value:g}: allowed: a positive number of seconds")
    return value


def longest_wait(asked: float | None) -> float:
    """Return the longest wait for cabinets [s], which is ``asked`` if the user gave it.

    Otherwise the wait is endless if a person at a terminal can end it, and :data:`SCRIPTS_WAIT_S` if not.
    """
    if asked is not None:
        return asked
    return math.inf if sys.stderr.isatty() else SCRIPTS_WAIT_S


def task_line(task: TaskResult) -> str:
    """Return one line of markup with the success of a task and its measured figures."""
    figures = ", ".join(
        f"{what.rpartition('_')[0].replace('_', ' ')} {value:.1f} {what.rpartition('_')[2]}"
        for what, value in task.measured.items()
    )
    verdict = "[green]succeeded[/]" if task.succeeded else f"[red]failed[/]: {escape(task.reason)}"
    return f"{task.name} {verdict} ({figures})"


def late_line(summary: RunSummary, tasks: Iterable[TaskResult]) -> str | None:
    """Return one line of markup if a task failed and the loop was late; otherwise None."""
    late, often = summary.lateness_us.max, summary.overruns > _OFTEN * summary.ticks
    if late is None or not (late >= _LATE or often) or all(task.succeeded for task in tasks):
        return None
    line = f"the loop was late by up to {1e-3 * late:.0f} ms, in {summary.overruns} ticks by more than a period"
    return f"[yellow]{line}[/]: close other programs, or give it priority with --rt"


class ProgressLines:
    """A listener of a run without a table. Every few seconds, it prints how much of the run is over."""

    def __init__(self, name: str, duration: float, console: Console) -> None:
        """``name`` is the run's name. ``duration`` is how long the run lasts [s]."""
        self._name, self._duration, self._console = name, duration, console
        self._due = time.monotonic() + _BETWEEN_TIMES_S  # When the next line is printed [s].

    def __call__(self, tick: Tick) -> None:
        if (now := time.monotonic()) >= self._due:
            self._due = now + _BETWEEN_TIMES_S
            say(f"{self._name}: {tick.t:.1f} of {self._duration:g} s", self._console)


def print_lines(console: Console, lines: Iterable[str]) -> None:
    """Print lines of markup, each without a break at the width of the terminal."""
    for line in lines:
        console.print(line, soft_wrap=True, highlight=False)


def recording_line(recording: RecordingSummary) -> str:
    """Return one line of markup with the file of a recording, and with the data that is missing in it."""
    if recording.fault is not None:
        ended = f"[red]recording ended[/]: {escape(recording.fault)}"
        return f"{ended}; {recording.ticks} ticks recorded, {recording.lost_ticks} not"
    found = [f"{recording.ticks} ticks"]
    if recording.lost_ticks:
        found.append(f"[red]{recording.lost_ticks} lost[/]: the queue was full")
    if recording.pictures or recording.lost_pictures or recording.pictures_fault:
        found.append(f"{recording.pictures} pictures")
    if recording.lost_pictures:
        why = recording.pictures_fault or "they did not come fast enough"
        found.append(f"[red]{recording.lost_pictures} lost[/]: {escape(why)}")
    return f"recording: {escape(str(recording.file))} ({', '.join(found)})"


def verdict_markup(verdict: Verdict) -> str:
    """Return markup that says whether an episode is kept, and the reasons if it is not.

    If there are several reasons, each has its own line.
    """
    word = f"[{'green' if verdict.keep else 'red'}]{verdict.word}[/]"
    found = [escape(finding) for finding in verdict.findings]
    return f"{word}: {found[0]}" if len(found) == 1 else "\n    ".join([f"{word}:" if found else word, *found])
