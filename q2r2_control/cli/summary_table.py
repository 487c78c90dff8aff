"""The summary of a run as a table."""

from __future__ import annotations

from collections.abc import Sequence

from rich.markup import escape
from rich.table import Table

from q2r2_control.demo.assembly_tasks import TaskResult
from q2r2_control.events import Event, ReasonKind
from q2r2_control.judging.verdict import Verdict
from q2r2_control.recording.recorder import RecordingSummary
from q2r2_control.summary.histogram import Percentiles
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.torque_summary import TorqueSummary
from q2r2_control.teleop.arm_states import ArmState, is_fault
from q2r2_control.wording import sentence


def summary_table(summary: RunSummary) -> Table:
    """The figures of a run."""
    table = Table(title="summary", title_justify="left", show_header=False)
    table.add_row("duration", f"{summary.duration_s:.2f} s, {summary.ticks} ticks, {summary.loop_rate_hz:.0f} Hz")
    table.add_row("tick", _percentiles(summary.tick_us, "us", 0))
    if summary.lateness_us.max is not None:
        late = f"{_percentiles(summary.lateness_us, 'us', 0)}; {summary.overruns} by more than a period"
        table.add_row("ticks late by", late)
    table.add_row("input to command", _percentiles(summary.input_to_command_ms, "ms", 2))
    for name, arm in summary.arms.items():
        figures = f"engaged {arm.engaged_s:.2f} s"
        if arm.position_error_mm_rms is not None and arm.rotation_error_deg_rms is not None:
            figures += f", error {arm.position_error_mm_rms:.2f} mm, {arm.rotation_error_deg_rms:.2f} deg RMS"
        if arm.slip_mm_max > 0.0 or arm.slip_deg_max > 0.0:
            figures += f", target slipped {arm.slip_mm_max:.0f} mm, {arm.slip_deg_max:.0f} deg"
        if arm.yielded_mm_max > 0.0 or arm.yielded_deg_max > 0.0:
            figures += f", yielded {arm.yielded_mm_max:.0f} mm, {arm.yielded_deg_max:.0f} deg"
        figures += f", gripper changes {arm.gripper_changes}"
        table.add_row(f"{name} arm", figures)
        if arm.gripper_held_by is not None:
            by = " | ".join(arm.gripper_held_by)
            table.add_row(f"{name} gripper held for", f"{arm.gripper_held_s:.2f} s, by {by}")
        if arm.object_held_s is not None:
            table.add_row(f"{name} object part of the tool for", f"{arm.object_held_s:.2f} s")
    if summary.min_distance_mm is not None and summary.closest_pair is not None:
        table.add_row("nearest pair", f"{summary.min_distance_mm:.1f} mm, {' | '.join(summary.closest_pair)}")
    table.add_row(
        "velocity, acceleration",
        f"{_share(summary.max_velocity_ratio)} of the limits at most, {_share(summary.max_acceleration_ratio)}",
    )
    table.add_row("room to position limits", f"{summary.min_position_margin_rad:.3f} rad at least")
    uncertified = f"{summary.uncertified_ticks} ticks without a certificate"
    if summary.uncertified_ticks:
        uncertified = f"[red]{uncertified}[/]"
    table.add_row("certified stops executed", f"{summary.fallback_ticks} ticks; {uncertified}")
    table.add_row("targets rejected", str(summary.rejected_targets))
    table.add_row(
        "ticks missed", f"{summary.missed_ticks}, which made the motion {summary.stretched_s:.2f} s late in all"
    )
    for name, event in _last_pauses(summary.events).items():
        label = f"{name} arm" if event.kind is ReasonKind.NOT_ENGAGED else f"{name} arm paused by"
        table.add_row(label, f"[yellow]{escape(sentence(event.reason))}[/], at {event.t:.2f} s")
    if summary.torque is not None:
        _add_torque(table, summary.torque)
    table.add_row("arms at the end", "at rest" if summary.at_rest else "[red]moving[/]")
    return table


def task_line(task: TaskResult) -> str:
    """One line of markup: whether a task succeeded, and what was measured of it."""
    figures = ", ".join(
        f"{what.rpartition('_')[0].replace('_', ' ')} {_figure(what, value)}" for what, value in task.measured.items()
    )
    verdict = "[green]succeeded[/]" if task.succeeded else f"[red]failed[/]: {escape(task.reason)}"
    return f"{task.name} {verdict} ({figures})"


def recording_line(recording: RecordingSummary) -> str:
    """One line of markup: where a run was recorded, and what is missing of it."""
    if recording.fault is not None:
        ended = f"[red]recording ended[/]: {escape(recording.fault)}"
        return f"{ended}; {recording.ticks} ticks recorded, {recording.lost_ticks} not"
    lost = f", [red]{recording.lost_ticks} lost[/]: the queue was full" if recording.lost_ticks else ""
    return f"recording: {escape(str(recording.file))} ({recording.ticks} ticks{lost}{_pictures_of(recording)})"


def _pictures_of(recording: RecordingSummary) -> str:
    """What became of the pictures, where there are cameras."""
    if not (recording.pictures or recording.lost_pictures or recording.pictures_fault):
        return ""
    pictures = f", {recording.pictures} pictures"
    if recording.lost_pictures:
        why = recording.pictures_fault or "they could not be taken fast enough"
        pictures += f", [red]{recording.lost_pictures} lost[/]: {escape(why)}"
    return pictures


def verdict_markup(verdict: Verdict) -> str:
    """One line of markup: whether an episode is kept, and why not."""
    colour = "green" if verdict.keep else "red"
    return f"[{colour}]{verdict.word}[/]{escape(verdict.line.removeprefix(verdict.word))}"


def _figure(what: str, value: float) -> str:
    """With the unit that the figure's name ends with."""
    return f"{value:.1f} {what.rpartition('_')[2]}"


_IN_BETWEEN = (ArmState.PAUSING, ArmState.ALIGNING)


def _last_pauses(events: Sequence[Event]) -> dict[str, Event]:
    """The last event of each arm that something else than its button paused, or kept from being engaged."""
    last = {event.arm: event for event in events if event.destination not in _IN_BETWEEN}
    return {arm: event for arm, event in last.items() if is_fault(event)}


def _add_torque(table: Table, torque: TorqueSummary) -> None:
    if torque.min_measured_distance_mm is not None and torque.measured_closest_pair is not None:
        pair = " | ".join(torque.measured_closest_pair)
        table.add_row("nearest measured pair", f"{torque.min_measured_distance_mm:.1f} mm, {pair}")
    pressed = ", ".join(" | ".join(pair) for pair in torque.pressed_pairs)
    force = f": {torque.max_wall_force_n:.0f} N at most" if pressed else ""
    table.add_row("wall pressed by", f"{pressed or 'no pair'}{force}")
    limits = f"{torque.saturated_ticks} ticks at a limit, {torque.rate_limited_ticks} at the rate limit"
    table.add_row("torque", f"{limits}, {torque.held_ticks} held without a measurement")
    for arm, time in torque.off_reference_s.items():
        if time > 0.0:
            table.add_row(f"{arm} arm off its reference", f"[red]{time:.2f} s[/] beyond the impedance's error clip")


def _percentiles(values: Percentiles, unit: str, digits: int) -> str:
    if values.p50 is None or values.p99 is None or values.max is None:
        return "-"
    return f"median {values.p50:.{digits}f} {unit}, p99 {values.p99:.{digits}f}, max {values.max:.{digits}f}"


def _share(ratio: float) -> str:
    return f"{100.0 * ratio:.0f} %"
