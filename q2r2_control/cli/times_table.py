"""The tables of ``q2r2 bench``."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.tick_times import BenchReport, BenchRow
from q2r2_control.cli.figure_table import figure_table


def times_table(report: BenchReport) -> Table:
    """Times of a tick."""
    table = figure_table(
        f"{report.cell}: one tick of 1 ms with {report.pairs} pairs, each run of {report.rows[0].ticks} ticks",
        "controller",
        ("runs", "median [us]", "p99 [us]", "max [us]", "median / ours", "p99 / ours"),
    )
    for row in _by_scenario(report, table):
        ratios = ("" if ratio is None else f"{ratio:.2f}" for ratio in (row.median_ratio, row.p99_ratio))
        times = (f"{value:.0f}" for value in (row.median_us, row.p99_us, row.max_us))
        table.add_row(f"  {row.controller}", str(row.rounds), *times, *ratios)
    return table


def motion_table(report: BenchReport) -> Table:
    """Metrics of the controllers' motions, with notes on the limitations of each."""
    table = figure_table(
        "motion",
        "controller",
        ("a / limit", "v / limit", "room [rad]", "nearest [mm]", "held", "tail [rad/s^2]"),
    )
    for row in _by_scenario(report, table):
        metrics = row.metrics
        table.add_row(
            f"  {row.controller}",
            f"{metrics.max_acceleration_ratio:.2f}",
            f"{metrics.max_velocity_ratio:.2f}",
            f"{metrics.min_position_margin_rad:.3f}",
            f"{metrics.min_distance_mm:.2f}",
            str(metrics.failures if row.fallback_ticks is None else row.fallback_ticks),
            f"{metrics.tail_acceleration:.3f}",
        )
    held = "held: ticks without a solution, in which a peer's arms stand still and ours execute the certified stop"
    table.caption = Text("\n".join([held, *report.notes]))
    table.caption_justify = "left"
    return table


def _by_scenario(report: BenchReport, table: Table) -> Iterator[BenchRow]:
    """The rows; each scenario's heading is added to the table before its first row."""
    heading = ""
    for row in report.rows:
        if row.name != heading:
            heading = row.name
            table.add_row(Text(heading, style="bold"))
        yield row
