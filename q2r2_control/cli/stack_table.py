"""The tables of ``q2r2 bench --work --through``: how well the tools follow the hands, and what that takes."""

from __future__ import annotations

from collections.abc import Callable

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.stack_bench import StackReport
from q2r2_control.benchmark.stack_run import StackFigures
from q2r2_control.cli.figure_table import figure_table
from q2r2_control.cli.work_table import short_figure

_FOLLOWING = """\
RMS, max, end: from where the hand asks the worse tool to be to where it is measured at that instant, all delays in it
path: RMS from where the hand asked it to be the filter's delay before; free: the same samples in free air
there: time until both tools are within 10 mm of the goal for good; no: they are not at the end
slip: how far the leash moved a target; (!) not all targets can be reached with every distance kept"""
_SAFETY = """\
held: ticks in which the certified stop is executed
near: nearest monitored pair where the arms are measured; ref: of the reference
spare: least measured distance beyond the one that its pair keeps; below 0: closer than kept
a, tau: greatest acceleration of the reference and torque of a motor, as shares of the joint's limit
rest: RMS of the joints' acceleration in the last 0.5 s, under hands that rest but for the sensor's noise"""


def following_table(report: StackReport) -> Table:
    """How well the measured tools follow the hands, in every motion and mode."""
    table = figure_table(
        f"{report.cell}: work motions from hand samples to MuJoCo at {report.loop_rate_hz:g} Hz",
        "mode",
        ("RMS [mm]", "free [mm]", "max [mm]", "path [mm]", "free [mm]", "end [mm]", "there [s]", "slip [mm]"),
    )
    _fill(table, report, _following_cells)
    about = [f"{row.motion}: {row.about}" for row in report.rows]
    table.caption = Text("\n".join([*about, _FOLLOWING]))
    table.caption_justify = "left"
    return table


def safety_table(report: StackReport) -> Table:
    """Distances, efforts and rest, in every motion and mode; below them all that went wrong."""
    table = figure_table(
        f"{report.cell}: distances and efforts in these motions, {report.pairs} pairs",
        "mode",
        ("held [%]", "near [mm]", "ref [mm]", "spare [mm]", "a /limit", "tau /limit", "rest [s-2]"),
    )
    _fill(table, report, lambda figures, free: _safety_cells(figures))
    runs = [figures for row in report.rows for figures in row.figures]
    broken = sum(sum(figures.broken.values()) for figures in runs)
    checked = f"promises of the controller, checked at every tick of {len(runs)} runs: broken {broken} times"
    table.caption = Text("\n".join([_SAFETY, checked]))
    for figures in runs:
        for fault in _faults(figures):
            table.caption.append(f"\n{figures.motion}, {figures.mode}: {fault}", style="red")
    table.caption_justify = "left"
    return table


def _fill(table: Table, report: StackReport, cells: Callable[[StackFigures, StackFigures], tuple[str, ...]]) -> None:
    for row in report.rows:
        table.add_row(Text(f"{row.motion}{'' if row.reachable else ' (!)'}", style="bold"))
        for figures, free in zip(row.figures, row.free_air, strict=True):
            table.add_row(f"  {figures.mode}", *cells(figures, free), style=None if figures.passed else "red")


def _faults(figures: StackFigures) -> list[str]:
    stopped = [f"stopped at {100.0 * figures.done:.0f} %: {figures.stopped}"] if figures.stopped else []
    pauses = [f"paused: {pause}" for pause in figures.pauses]
    return stopped + pauses + [f"broken {count} times: {name}" for name, count in figures.broken.items()]


def _following_cells(figures: StackFigures, free: StackFigures) -> tuple[str, ...]:
    there = short_figure(figures.arrival_s)
    if figures.arrival_s is None and free.arrival_s is not None:
        there = "no"
    return (
        short_figure(figures.rms_error_mm),
        short_figure(free.rms_error_mm),
        short_figure(figures.max_error_mm),
        short_figure(figures.path_error_mm),
        short_figure(free.path_error_mm),
        short_figure(figures.end_error_mm),
        there,
        short_figure(figures.slip_mm),
    )


def _safety_cells(figures: StackFigures) -> tuple[str, ...]:
    return (
        short_figure(figures.fallback_percent),
        short_figure(figures.measured_distance_mm),
        short_figure(figures.reference_distance_mm),
        short_figure(figures.measured_margin_mm),
        short_figure(figures.max_acceleration_ratio),
        short_figure(figures.max_torque_ratio),
        short_figure(figures.rest_acceleration),
    )
