"""The summary of a run as a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.markup import escape
from rich.table import Table

from q2r2_control.demo.assembly_tasks import TaskResult
from q2r2_control.events import Event, ReasonKind
from q2r2_control.judging.judge import Verdict
from q2r2_control.recording.recorder import RecordingSummary
from q2r2_control.summary.run_summary import ArmSummary, Percentiles, RunSummary, TorqueSummary
from q2r2_control.teleop.arm_states import ArmState, is_fault
from q2r2_control.wording import sentence


def summary_table(summary: RunSummary) -> Table:
    """The figures of a run."""
    table = Table(title="summary", title_justify="left", show_header=False)
    for name, figures in _rows(summary):
        table.add_row(name, figures)
    return table


def _rows(summary: RunSummary) -> Iterator[tuple[str, str]]:
    yield "duration", f"{summary.duration_s:.2f} s, {summary.ticks} ticks, {summary.loop_rate_hz:.0f} Hz"
    yield "tick", _percentiles(summary.tick_us, "us", 0)
    if summary.lateness_us.max is not None:
        late = _percentiles(summary.lateness_us, "us", 0)
        yield "ticks late by", f"{late}; {summary.overruns} by more than a period"
    yield "input to command", _percentiles(summary.input_to_command_ms, "ms", 2)
    for name, arm in summary.arms.items():
        yield f"{name} arm", ", ".join(_arm_figures(arm))
        if arm.gripper_held_by is not None:
            yield f"{name} gripper held for", f"{arm.gripper_held_s:.2f} s, by {' | '.join(arm.gripper_held_by)}"
        if arm.object_held_s is not None:
            yield f"{name} object part of the tool for", f"{arm.object_held_s:.2f} s"
    if summary.min_distance_mm is not None and summary.closest_pair is not None:
        yield "nearest pair", f"{summary.min_distance_mm:.1f} mm, {' | '.join(summary.closest_pair)}"
    velocity, acceleration = (100.0 * ratio for ratio in (summary.max_velocity_ratio, summary.max_acceleration_ratio))
    yield "velocity, acceleration", f"{velocity:.0f} % of the limits at most, {acceleration:.0f} %"
    yield "room to position limits", f"{summary.min_position_margin_rad:.3f} rad at least"
    uncertified = _red(f"{summary.uncertified_ticks} ticks without a certificate", summary.uncertified_ticks > 0)
    yield "certified stops executed", f"{summary.fallback_ticks} ticks; {uncertified}"
    yield "targets rejected", str(summary.rejected_targets)
    yield "ticks missed", f"{summary.missed_ticks}, which made the motion {summary.stretched_s:.2f} s late in all"
    for name, event in _last_pauses(summary.events).items():
        label = f"{name} arm" if event.kind is ReasonKind.NOT_ENGAGED else f"{name} arm paused by"
        yield label, f"[yellow]{escape(sentence(event.reason))}[/], at {event.t:.2f} s"
    if summary.torque is not None:
        yield from _torque_rows(summary.torque)
    yield "arms at the end", "at rest" if summary.at_rest else _red("moving")


def _arm_figures(arm: ArmSummary) -> Iterator[str]:
    yield f"engaged {arm.engaged_s:.2f} s"
    if arm.position_error_mm_rms is not None and arm.rotation_error_deg_rms is not None:
        yield f"error {arm.position_error_mm_rms:.2f} mm, {arm.rotation_error_deg_rms:.2f} deg RMS"
    if arm.slip_mm_max > 0.0 or arm.slip_deg_max > 0.0:
        yield f"target slipped {arm.slip_mm_max:.0f} mm, {arm.slip_deg_max:.0f} deg"
    if arm.yielded_mm_max > 0.0 or arm.yielded_deg_max > 0.0:
        yield f"yielded {arm.yielded_mm_max:.0f} mm, {arm.yielded_deg_max:.0f} deg"
    yield f"gripper changes {arm.gripper_changes}"


def _red(text: str, wrong: bool = True) -> str:
    return f"[red]{text}[/]" if wrong else text


def task_line(task: TaskResult) -> str:
    """One line of markup: whether a task succeeded, and what was measured of it."""
    figures = ", ".join(
        f"{what.rpartition('_')[0].replace('_', ' ')} {value:.1f} {what.rpartition('_')[2]}"
        for what, value in task.measured.items()
    )
    verdict = "[green]succeeded[/]" if task.succeeded else f"[red]failed[/]: {escape(task.reason)}"
    return f"{task.name} {verdict} ({figures})"


def recording_line(recording: RecordingSummary) -> str:
    """One line of markup: where a run was recorded, and what is missing of it."""
    if recording.fault is not None:
        ended = f"{_red('recording ended')}: {escape(recording.fault)}"
        return f"{ended}; {recording.ticks} ticks recorded, {recording.lost_ticks} not"
    found = [f"{recording.ticks} ticks"]
    if recording.lost_ticks:
        found.append(f"{_red(f'{recording.lost_ticks} lost')}: the queue was full")
    if recording.pictures or recording.lost_pictures or recording.pictures_fault:
        found.append(f"{recording.pictures} pictures")
    if recording.lost_pictures:
        why = recording.pictures_fault or "they could not be taken fast enough"
        found.append(f"{_red(f'{recording.lost_pictures} lost')}: {escape(why)}")
    return f"recording: {escape(str(recording.file))} ({', '.join(found)})"


def verdict_markup(verdict: Verdict) -> str:
    """One line of markup: whether an episode is kept, and why not."""
    colour = "green" if verdict.keep else "red"
    return f"[{colour}]{verdict.word}[/]{escape(verdict.line.removeprefix(verdict.word))}"


_IN_BETWEEN = (ArmState.PAUSING, ArmState.ALIGNING)


def _last_pauses(events: Sequence[Event]) -> dict[str, Event]:
    """The last event of each arm that something else than its button paused, or kept from being engaged."""
    last = {event.arm: event for event in events if event.destination not in _IN_BETWEEN}
    return {arm: event for arm, event in last.items() if is_fault(event)}


def _torque_rows(torque: TorqueSummary) -> Iterator[tuple[str, str]]:
    if torque.min_measured_distance_mm is not None and torque.measured_closest_pair is not None:
        pair = " | ".join(torque.measured_closest_pair)
        yield "nearest measured pair", f"{torque.min_measured_distance_mm:.1f} mm, {pair}"
    pressed = ", ".join(" | ".join(pair) for pair in torque.pressed_pairs)
    force = f": {torque.max_wall_force_n:.0f} N at most" if pressed else ""
    yield "wall pressed by", f"{pressed or 'no pair'}{force}"
    limits = f"{torque.saturated_ticks} ticks at a limit, {torque.rate_limited_ticks} at the rate limit"
    yield "torque", f"{limits}, {torque.held_ticks} held without a measurement"
    for arm, time in torque.off_reference_s.items():
        if time > 0.0:
            yield f"{arm} arm off its reference", f"{_red(f'{time:.2f} s')} beyond the impedance's error clip"


def _percentiles(values: Percentiles, unit: str, digits: int) -> str:
    if values.p50 is None or values.p99 is None or values.max is None:
        return "-"
    return f"median {values.p50:.{digits}f} {unit}, p99 {values.p99:.{digits}f}, max {values.max:.{digits}f}"
