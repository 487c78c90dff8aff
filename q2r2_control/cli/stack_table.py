"""The table of ``q2r2 bench --work --through``."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.stack_bench import StackReport
from q2r2_control.benchmark.stack_run import StackFigures
from q2r2_control.cli.figure_table import figure_table
from q2r2_control.cli.work_table import short_figure

_LEGEND = """\
RMS, max: from where the hand asks the worse tool to be at that instant to where it is measured, all delays in it
free: RMS of the same samples in free air; path: RMS from where the hand asked it to be the filter's delay before
there: time until both tools are within 10 mm of the goal for good; no: they are not at the end
held: ticks in which the certified stop is executed; slip: how far the leash moved a target
near: nearest monitored pair where the arms are measured, ref: of the reference
spare: least measured distance beyond the one that its pair keeps; below 0: closer than kept
a, tau: greatest acceleration of the reference, and torque of a motor, as shares of the joint's limit
rest: RMS of the reference's acceleration [rad/s^2] in the last 0.5 s, under hands that rest but for the sensor's noise
(!) not all targets can be reached with every distance kept"""


def stack_table(report: StackReport) -> Table:
    """Every motion in every mode; below it, what went wrong."""
    table = figure_table(
        f"{report.cell}: work motions from hand samples to MuJoCo at {report.loop_rate_hz:g} Hz, {report.pairs} pairs",
        "mode",
        (
            *("RMS [mm]", "free [mm]", "max [mm]", "path [mm]", "there [s]", "held [%]", "near [mm]"),
            *("ref [mm]", "spare [mm]", "a /lim", "tau /lim", "slip [mm]", "rest [s-2]"),
        ),
        padding=0,
    )
    for row in report.rows:
        table.add_row(Text(f"{row.motion}{'' if row.reachable else ' (!)'}", style="bold"))
        for figures, free in zip(row.figures, row.free_air, strict=True):
            table.add_row(*_cells(figures, free))
            for fault in _faults(figures):
                table.add_row(Text(f" {fault}", style="red"))
    about = [f"{row.motion}: {row.about}" for row in report.rows]
    runs = [figures for row in report.rows for figures in row.figures]
    broken = sum(sum(figures.broken.values()) for figures in runs)
    checked = f"promises of the controller, checked at every tick of {len(runs)} runs: broken {broken} times"
    table.caption = Text("\n".join([*about, _LEGEND, checked]))
    table.caption_justify = "left"
    return table


def _faults(figures: StackFigures) -> list[str]:
    stopped = [f"stopped at {100.0 * figures.done:.0f} %: {figures.stopped}"] if figures.stopped else []
    pauses = [f"paused: {pause}" for pause in figures.pauses]
    return stopped + pauses + [f"broken {count} times: {name}" for name, count in figures.broken.items()]


def _cells(figures: StackFigures, free: StackFigures) -> tuple[str, ...]:
    there = short_figure(figures.arrival_s)
    if figures.arrival_s is None and free.arrival_s is not None:
        there = "no"
    return (
        figures.mode,
        short_figure(figures.rms_error_mm),
        short_figure(free.rms_error_mm),
        short_figure(figures.max_error_mm),
        short_figure(figures.path_error_mm),
        there,
        short_figure(figures.fallback_percent),
        short_figure(figures.measured_distance_mm),
        short_figure(figures.reference_distance_mm),
        short_figure(figures.measured_margin_mm),
        short_figure(figures.max_acceleration_ratio),
        short_figure(figures.max_torque_ratio),
        short_figure(figures.slip_mm),
        short_figure(figures.rest_acceleration),
    )
