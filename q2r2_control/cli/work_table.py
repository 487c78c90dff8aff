"""The table of ``q2r2 bench --work``."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.motion_run import PATIENCE, MotionFigures
from q2r2_control.benchmark.peers.base import WITHOUT_ACCELERATION_LIMIT
from q2r2_control.benchmark.work_bench import WorkReport, WorkRow
from q2r2_control.cli.figure_table import figure_table

_UNLIMITED = "*"
_LEGEND = f"""\
RMS, max: distance of the worse tool from its target, from approach to rest; free: RMS of ours in free air
there: time until both tools are within 10 mm of the goal for good; no: they are not at the end
held: ticks in which ours executes the certified stop; ticks without a solution, in which a peer's arms stand still
near: nearest monitored pair; |a|: greatest acceleration of a joint [rad/s^2]
rest: RMS of the joints' acceleration in the last 0.5 s, after 1.5 s of still targets
{_UNLIMITED} has no acceleration limit; (!) not all targets can be reached with every distance kept
gave up: took more than {PATIENCE:g} times the motion's own time; figures are of the share that was done
peers get their targets ahead by speed / gain, since they have no feed-forward"""


def work_table(report: WorkReport) -> Table:
    """Every motion with our controller and the peers, and notes on the limitations of each."""
    table = figure_table(
        f"{report.cell}: work motions in ticks of 1 ms, {report.pairs} pairs",
        "controller",
        (
            *("RMS [mm]", "max [mm]", "free [mm]", "there [s]", "held [%]"),
            *("near [mm]", "|a| [s-2]", "rest [s-2]", "p50 [us]", "p99 [us]"),
        ),
        padding=0,
    )
    for row in report.rows:
        table.add_row(Text(f"{row.motion}{'' if row.reachable else ' (!)'}", style="bold"))
        for figures in row.figures:
            table.add_row(*_cells(row, figures, ours=figures is row.figures[0]))
            if figures.done < 1.0:
                table.add_row(Text(f" gave up at {100.0 * figures.done:.0f} %", style="red"))
    about = [f"{row.motion}: {row.about}" for row in report.rows]
    table.caption = Text("\n".join([*about, _LEGEND, *report.notes]))
    table.caption_justify = "left"
    return table


def _cells(row: WorkRow, figures: MotionFigures, ours: bool) -> tuple[str, ...]:
    limited = figures.controller not in WITHOUT_ACCELERATION_LIMIT
    held = figures.fallback_percent
    if held is None and figures.ticks:
        held = 100.0 * figures.failures / figures.ticks
    there = short_figure(figures.arrival_s)
    if figures.arrival_s is None and row.free_air.arrival_s is not None:
        there = "no"
    return (
        figures.controller,
        short_figure(figures.rms_error_mm),
        short_figure(figures.max_error_mm),
        short_figure(row.free_air.rms_error_mm) if ours else "",
        there,
        short_figure(held),
        short_figure(figures.min_distance_mm),
        short_figure(figures.max_acceleration) + ("" if limited else _UNLIMITED),
        short_figure(figures.rest_acceleration),
        short_figure(figures.median_us),
        short_figure(figures.p99_us),
    )


def short_figure(value: float | None) -> str:
    """Four characters or so: two digits after the point below 10, one below 100, none above."""
    if value is None:
        return "-"
    digits = 2 if abs(value) < 9.995 else 1 if abs(value) < 99.95 else 0
    return f"{value:.{digits}f}"
