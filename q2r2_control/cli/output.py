"""Output of commands: JSON on stdout, the summary of a run, and all else on stderr or as tables."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

from pydantic_core import to_json
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table
from rich.text import Text
from typer import Argument, Option

from q2r2_control.config.cell import Config
from q2r2_control.control.jit import compiling
from q2r2_control.control.solvers.registry import check_installed
from q2r2_control.demo.assembly_tasks import TaskResult
from q2r2_control.errors import ConfigError
from q2r2_control.events import ReasonKind
from q2r2_control.judging.judge import Verdict
from q2r2_control.recording.recorder import RecordingSummary
from q2r2_control.summary.run_summary import ArmSummary, Percentiles, RunSummary, TorqueSummary
from q2r2_control.teleop.arm_states import ArmState, is_fault
from q2r2_control.viewer.tables import figure_table, print_table
from q2r2_control.wording import sentence

# A loop that was late by more [us], or by over a period in a larger share of its ticks, may be why a task failed.
_LATE, _OFTEN = 2e4, 0.2
# Time without a word about kernels that are being compiled, and between two lines about them [s].
_SILENT_S, _BETWEEN_LINES_S = 3.0, 5.0
SCRIPTS_WAIT_S = 60.0  # for cabinets, where nobody is at a terminal who could end the wait
DEMO_CONFIG = "config/dual_iiwa7.yaml"

ConfigFile = Annotated[str, Argument(metavar="CONFIG", help="The cell's YAML, such as config/dual_iiwa7.yaml.")]
RealTime = Annotated[bool, Option("--rt", help="Lock memory and run under SCHED_FIFO, as far as permitted.")]
WebHost = Annotated[str, Option(metavar="HOST", help="Address of the page; beyond 127.0.0.1: HTTPS and a token.")]
WebPort = Annotated[int, Option(min=0, max=65535, metavar="PORT", help="Port of the page; 0: any free one.")]
Wait = Annotated[
    float | None,
    Option(
        min=0, metavar="SECONDS", help="For KUKA's cabinets to be there; by default 60, and without end at a terminal."
    ),
]
Json = Annotated[bool, Option("--json", help="Print one JSON object on stdout, and all else on stderr.")]
Task = Annotated[str | None, Option(help="With --record: what is done, noted in the recording.")]
Solver = Annotated[
    str | None, Option(metavar="NAME", help="Of the QP, not control.solver: daqp, osqp, or another that is installed.")
]
Anonymous = Annotated[
    bool, Option("--anonymous", help="Leave out the operator and the name of the computer that recorded.")
]
Operator = Annotated[str | None, Option(help="With --record: whose hands, noted as well.")]


def as_json_text(value: Any) -> str:
    """``value`` as strict JSON: dataclasses and mappings as objects, arrays as lists, what is not finite as null."""
    return to_json(value, inf_nan_mode="null", fallback=lambda array: array.tolist()).decode()


def with_solver(config: Config, name: str | None) -> Config:
    """The cell with the QP solver called ``name``; None: with its own. Raises :class:`ConfigError` without one."""
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
    """Print one line as it is, however long, on stderr or ``console``."""
    (console or Console(stderr=True)).print(line, style=style, soft_wrap=True, highlight=False, markup=False)


@contextmanager
def counting(what: str = "") -> Iterator[Callable[[str, int, int], None]]:
    """Show how far a long work has got, where stderr is a terminal, by what it is told: what, how many done, of all."""
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(what, total=None)
        yield lambda of, done, total: progress.update(task, description=of or what, completed=done, total=total)


def print_progress(what: str) -> None:
    """Print a line on stderr, where that is a terminal; a live line would need a thread, which adds to times."""
    console = Console(stderr=True)
    if console.is_terminal:
        console.print(what, highlight=False)


class _CompilingLines:
    """Says how far compiling the controller's kernels has got, a line every few seconds."""

    def __init__(self) -> None:
        self._start: float | None = None
        self._due = 0.0

    def __call__(self, done: int, total: int) -> None:
        """Print a line if one is due; the time to go is that of the kernels that are done, scaled to the rest."""
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
    """Say what takes so long, where the controller's kernels have to be compiled for longer than three seconds."""
    with compiling(_CompilingLines()):
        yield


def notes_of(task: str | None, operator: str | None, record: object) -> dict[str, str]:
    """Notes for a recording. Raises :class:`ConfigError` where there is none."""
    notes = {name: text for name, text in (("task", task), ("operator", operator)) if text is not None}
    for name in notes:
        if record is None:
            raise ConfigError(f"--{name} needs --record")
        if not notes[name].strip():
            raise ConfigError(f"--{name} is empty; allowed: some words, or no --{name}")
    return notes


def positive(option: str, value: float | None) -> float | None:
    """``value`` [s] of ``option``, if one is given. Raises :class:`ConfigError` unless it is positive and finite."""
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"{option} {value:g}: allowed: a positive number of seconds")
    return value


def longest_wait(asked: float | None) -> float:
    """The time to wait for cabinets [s]: as ``asked``; else without end if a person at a terminal can end it."""
    if asked is not None:
        return asked
    return math.inf if sys.stderr.isatty() else SCRIPTS_WAIT_S


def summary_table(summary: RunSummary) -> Table:
    """The figures of a run."""
    rows = ((name, Text.from_markup(figures)) for name, figures in _rows(summary))
    return figure_table("summary", ("figure", "value"), rows)


def _rows(summary: RunSummary) -> Iterator[tuple[str, str]]:
    factor = "" if summary.real_time_factor is None else f", {summary.real_time_factor:.1f} x real time"
    yield "duration", f"{summary.duration_s:.2f} s, {summary.ticks} ticks, {summary.loop_rate_hz:.0f} Hz{factor}"
    yield "tick", _percentiles(summary.tick_us, "us", 0)
    if summary.lateness_us.max is not None:
        late = _percentiles(summary.lateness_us, "us", 0)
        yield "ticks late by", f"{late}; {summary.overruns} by more than a period"
    yield "input to command", _percentiles(summary.input_to_command_ms, "ms", 2)
    for name, arm in summary.arms.items():
        yield f"{name} arm", ", ".join(_arm_figures(arm))
        if not arm.followed:
            yield (
                f"{name} arm at the end",
                f"[red]{arm.end_error_mm:.0f} mm from its reference[/]: the tool did not follow",
            )
        if arm.policy_s > 0.0 or arm.interventions:
            taken_over = f"{arm.interventions} interventions, {arm.intervention_s:.2f} s"
            yield f"{name} arm by the policy", f"{arm.policy_s:.2f} s; {taken_over}"
        if arm.gripper_held_by is not None:
            yield f"{name} gripper held for", f"{arm.gripper_held_s:.2f} s, by {' | '.join(arm.gripper_held_by)}"
        if arm.object_held_s is not None:
            yield f"{name} object part of the tool for", f"{arm.object_held_s:.2f} s"
    if summary.min_distance_mm is not None and summary.closest_pair is not None:
        yield "nearest pair", f"{summary.min_distance_mm:.1f} mm, {' | '.join(summary.closest_pair)}"
    velocity, acceleration = (100.0 * ratio for ratio in (summary.max_velocity_ratio, summary.max_acceleration_ratio))
    yield "velocity, acceleration", f"{velocity:.0f} % of the limits at most, {acceleration:.0f} %"
    yield "room to position limits", f"{summary.min_position_margin_rad:.3f} rad at least"
    uncertified = f"{summary.uncertified_ticks} ticks without a certificate"
    uncertified = f"[red]{uncertified}[/]" if summary.uncertified_ticks else uncertified
    yield "certified stops executed", f"{summary.fallback_ticks} ticks; {uncertified}"
    yield "targets rejected", str(summary.rejected_targets)
    if summary.missed_ticks:
        yield "ticks missed", f"{summary.missed_ticks}, which made the motion {summary.stretched_s:.2f} s late in all"
    # The last event of each arm, if something else than its button paused it, or kept it from being engaged.
    between = (ArmState.PAUSING, ArmState.ALIGNING)
    last = {event.arm: event for event in summary.events if event.destination not in between}
    for name, event in last.items():
        if is_fault(event):
            label = f"{name} arm" if event.kind is ReasonKind.NOT_ENGAGED else f"{name} arm paused by"
            yield label, f"[yellow]{escape(sentence(event.reason))}[/], at {event.t:.2f} s"
    if summary.torque is not None:
        yield from _torque_rows(summary.torque)
    yield "arms at the end", "at rest" if summary.at_rest else "[red]moving[/]"


def _arm_figures(arm: ArmSummary) -> Iterator[str]:
    yield f"engaged {arm.engaged_s:.2f} s"
    if arm.position_error_mm_rms is not None and arm.rotation_error_deg_rms is not None:
        yield f"error {arm.position_error_mm_rms:.2f} mm, {arm.rotation_error_deg_rms:.2f} deg RMS"
    if arm.slip_mm_max > 0.0 or arm.slip_deg_max > 0.0:
        yield f"target slipped {arm.slip_mm_max:.0f} mm, {arm.slip_deg_max:.0f} deg"
    if arm.yielded_mm_max > 0.0 or arm.yielded_deg_max > 0.0:
        yield f"yielded {arm.yielded_mm_max:.0f} mm, {arm.yielded_deg_max:.0f} deg"
    yield f"gripper changes {arm.gripper_changes}"


def task_line(task: TaskResult) -> str:
    """One line of markup: whether a task succeeded, and what was measured of it."""
    figures = ", ".join(
        f"{what.rpartition('_')[0].replace('_', ' ')} {value:.1f} {what.rpartition('_')[2]}"
        for what, value in task.measured.items()
    )
    verdict = "[green]succeeded[/]" if task.succeeded else f"[red]failed[/]: {escape(task.reason)}"
    return f"{task.name} {verdict} ({figures})"


def late_line(summary: RunSummary, tasks: Iterable[TaskResult]) -> str | None:
    """One line of markup where a task failed in a run whose loop was late; else None."""
    late, often = summary.lateness_us.max, summary.overruns > _OFTEN * summary.ticks
    if late is None or not (late >= _LATE or often) or all(task.succeeded for task in tasks):
        return None
    line = f"the loop was late by up to {1e-3 * late:.0f} ms, in {summary.overruns} ticks by more than a period"
    return f"[yellow]{line}[/]: close other programs, or give it priority with --rt"


def recording_line(recording: RecordingSummary) -> str:
    """One line of markup: where a run was recorded, and what is missing of it."""
    if recording.fault is not None:
        ended = f"[red]recording ended[/]: {escape(recording.fault)}"
        return f"{ended}; {recording.ticks} ticks recorded, {recording.lost_ticks} not"
    found = [f"{recording.ticks} ticks"]
    if recording.lost_ticks:
        found.append(f"[red]{recording.lost_ticks} lost[/]: the queue was full")
    if recording.pictures or recording.lost_pictures or recording.pictures_fault:
        found.append(f"{recording.pictures} pictures")
    if recording.lost_pictures:
        why = recording.pictures_fault or "they could not be taken fast enough"
        found.append(f"[red]{recording.lost_pictures} lost[/]: {escape(why)}")
    return f"recording: {escape(str(recording.file))} ({', '.join(found)})"


def verdict_markup(verdict: Verdict) -> str:
    """One line of markup: whether an episode is kept, and why not."""
    colour = "green" if verdict.keep else "red"
    return f"[{colour}]{verdict.word}[/]{escape(verdict.line.removeprefix(verdict.word))}"


def _torque_rows(torque: TorqueSummary) -> Iterator[tuple[str, str]]:
    if torque.min_measured_distance_mm is not None and torque.measured_closest_pair is not None:
        pair = " | ".join(torque.measured_closest_pair)
        found = f"{torque.min_measured_distance_mm:.1f} mm, {pair}"
        met = f"[red]measured links met: {found}; what was measured broke what was promised[/]"
        yield "nearest measured pair", met if torque.met else found
    pressed = ", ".join(" | ".join(pair) for pair in torque.pressed_pairs)
    force = f": {torque.max_wall_force_n:.0f} N at most" if pressed else ""
    yield "wall pressed by", f"{pressed or 'no pair'}{force}"
    limits = f"{torque.saturated_ticks} ticks at a limit, {torque.rate_limited_ticks} at the rate limit"
    yield "torque", f"{limits}, {torque.held_ticks} held without a measurement"
    for arm, off_s in torque.off_reference_s.items():
        if off_s > 0.0:
            yield f"{arm} arm off its reference", f"[red]{off_s:.2f} s[/] beyond the impedance's error clip"


def _percentiles(values: Percentiles, unit: str, digits: int) -> str:
    if values.p50 is None or values.p99 is None or values.max is None:
        return "-"
    return f"median {values.p50:.{digits}f} {unit}, p99 {values.p99:.{digits}f}, max {values.max:.{digits}f}"
