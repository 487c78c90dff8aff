"""The summary of a run that is printed: the verdict and the most important figures; with ``--verbose``, all figures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rich.markup import escape
from rich.table import Table
from rich.text import Text

from q2r2_control.events import Event
from q2r2_control.summary.run_summary import ArmSummary, Percentiles, RunSummary, TorqueSummary
from q2r2_control.teleop.arm_states import ArmState, is_fault, is_refusal
from q2r2_control.viewer.tables import figure_table, times_real_time
from q2r2_control.wording import sentence


def verdict_line(summary: RunSummary, failed: Iterable[str] = (), stopped: str | None = None) -> str:
    """Return one line of markup. It says that all promises were kept and which arms followed, or else names the faults.

    Args:
        summary: The summary of the run.
        failed: Further failures in words, such as failed tasks.
        stopped: The line to return if the run was stopped before its tasks were over and there is no failure; otherwise
            None.
    """
    wrong = [*summary.broken, *failed]
    if wrong:
        return f"[red]not as it should be[/]: {escape('; '.join(wrong))}"
    if stopped is not None:
        return stopped
    if stops := _last_faults(summary):
        told = (f"{name} arm {escape(sentence(event.reason))}" for name, event in stops.items())
        return f"[yellow]an arm was stopped or refused[/]: {'; '.join(told)}"
    kept = "every tick certified, at rest at the end"
    moved = [name for name, arm in summary.arms.items() if arm.engaged_s > 0.0 or arm.policy_s > 0.0]
    if not moved:
        return f"[yellow]no arm was engaged[/]: {kept}"
    return f"[green]as it should be[/]: {' and '.join(moved)} followed, {kept}"


def _last_faults(summary: RunSummary) -> dict[str, Event]:
    """Return the last event of each arm whose last event is a fault.

    A fault is an event in which something other than a button paused the arm or kept the arm from engaging.
    """
    between = (ArmState.PAUSING, ArmState.ALIGNING)
    last = {event.arm: event for event in summary.events if event.destination not in between}
    return {name: event for name, event in last.items() if is_fault(event)}


def summary_table(summary: RunSummary, verbose: bool = False) -> Table:
    """Return a table of the run's result; with ``verbose``, it also has times, limits and torques."""
    figures = [*_result(summary), *(_details(summary) if verbose else _unusual(summary))]
    rows = ((name, Text.from_markup(value)) for name, value in figures)
    notes = () if verbose else ("--verbose has all figures",)
    return figure_table("summary", ("figure", "value"), rows, notes)


def _result(summary: RunSummary) -> Iterator[tuple[str, str]]:
    factor = summary.real_time_factor
    pace = f"{summary.loop_rate_hz:.0f} Hz" if factor is None else times_real_time(factor)
    yield "duration", f"{summary.duration_s:.2f} s, {summary.ticks} ticks, {pace}"
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
    if summary.missed_ticks:
        due = summary.missed_ticks + summary.ticks
        yield "ticks missed", f"{summary.missed_ticks} of {due}; the motion took {summary.stretched_s:.2f} s longer"
    yield from _faults(summary)
    yield "arms at the end", "at rest" if summary.at_rest else "[red]moving[/]"


def _faults(summary: RunSummary) -> Iterator[tuple[str, str]]:
    """Yield each arm's last pause by a fault, the number of such pauses, and its last event if that is a refusal."""
    last = _last_faults(summary)
    for name in summary.arms:
        pauses = [event for event in summary.events if event.arm == name and is_fault(event) and not is_refusal(event)]
        if pauses:
            is_paused = last.get(name) == pauses[-1]
            told = _moment(pauses[-1], "yellow" if is_paused else "default")
            yield f"{name} arm paused by", told if len(pauses) == 1 else f"{told}, the last of {len(pauses)} pauses"
        if name in last and is_refusal(last[name]):
            yield f"{name} arm", _moment(last[name], "yellow")


def _moment(event: Event, colour: str) -> str:
    return f"[{colour}]{escape(sentence(event.reason))}[/], at {event.t:.2f} s"


def _unusual(summary: RunSummary) -> Iterator[tuple[str, str]]:
    """Yield the figures that are shown even without ``verbose`` if they are not zero."""
    if summary.fallback_ticks or summary.uncertified_ticks:
        yield _stops(summary)
    if summary.rejected_targets:
        yield "targets rejected", str(summary.rejected_targets)
    if summary.torque is not None:
        yield from _torque_faults(summary.torque)


def _details(summary: RunSummary) -> Iterator[tuple[str, str]]:
    yield "tick", _percentiles(summary.tick_us, "us", 0)
    if summary.lateness_us.max is not None:
        late = _percentiles(summary.lateness_us, "us", 0)
        yield "ticks late by", f"{late}; {summary.overruns} by more than a period"
    yield "input to command", _percentiles(summary.input_to_command_ms, "ms", 2)
    velocity, acceleration = (100.0 * ratio for ratio in (summary.max_velocity_ratio, summary.max_acceleration_ratio))
    yield "velocity, acceleration", f"{velocity:.0f} % of the limits at most, {acceleration:.0f} %"
    yield "room to position limits", f"{summary.min_position_margin_rad:.3f} rad at least"
    yield _stops(summary)
    yield "targets rejected", str(summary.rejected_targets)
    if summary.torque is not None:
        yield from _torque_rows(summary.torque)


def _stops(summary: RunSummary) -> tuple[str, str]:
    uncertified = f"{summary.uncertified_ticks} ticks without a certificate"
    uncertified = f"[red]{uncertified}[/]" if summary.uncertified_ticks else uncertified
    return "certified stops executed", f"{summary.fallback_ticks} ticks; {uncertified}"


def _arm_figures(arm: ArmSummary) -> Iterator[str]:
    yield f"engaged {arm.engaged_s:.2f} s"
    if arm.position_error_mm_rms is not None and arm.rotation_error_deg_rms is not None:
        yield f"error {arm.position_error_mm_rms:.2f} mm, {arm.rotation_error_deg_rms:.2f} deg RMS"
    if arm.slip_mm_max > 0.0 or arm.slip_deg_max > 0.0:
        yield f"target slipped {arm.slip_mm_max:.0f} mm, {arm.slip_deg_max:.0f} deg"
    if arm.yielded_mm_max > 0.0 or arm.yielded_deg_max > 0.0:
        yield f"yielded {arm.yielded_mm_max:.0f} mm, {arm.yielded_deg_max:.0f} deg"
    yield f"gripper changes {arm.gripper_changes}"


def _torque_rows(torque: TorqueSummary) -> Iterator[tuple[str, str]]:
    if not torque.met and torque.min_measured_distance_mm is not None and torque.measured_closest_pair is not None:
        pair = " | ".join(torque.measured_closest_pair)
        yield "nearest measured pair", f"{torque.min_measured_distance_mm:.1f} mm, {pair}"
    pressed = ", ".join(" | ".join(pair) for pair in torque.pressed_pairs)
    force = f": {torque.max_wall_force_n:.0f} N at most" if pressed else ""
    yield "wall pressed by", f"{pressed or 'no pair'}{force}"
    limits = f"{torque.saturated_ticks} ticks at a limit, {torque.rate_limited_ticks} at the rate limit"
    yield "torque", f"{limits}, {torque.held_ticks} held without a measurement"
    yield from _torque_faults(torque)


def _torque_faults(torque: TorqueSummary) -> Iterator[tuple[str, str]]:
    if torque.met and torque.measured_closest_pair is not None:
        found = f"{torque.min_measured_distance_mm:.1f} mm, {' | '.join(torque.measured_closest_pair)}"
        yield "nearest measured pair", f"[red]measured links met: {found}; what was measured broke what was promised[/]"
    for arm, off_s in torque.off_reference_s.items():
        if off_s > 0.0:
            yield f"{arm} arm off its reference", f"[red]{off_s:.2f} s[/] beyond the impedance's error clip"


def _percentiles(values: Percentiles, unit: str, digits: int) -> str:
    if values.p50 is None or values.p99 is None or values.max is None:
        return "-"
    return f"median {values.p50:.{digits}f} {unit}, p99 {values.p99:.{digits}f}, max {values.max:.{digits}f}"
