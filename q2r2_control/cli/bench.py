"""``q2r2 bench``: the controller beside public ones, on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from operator import attrgetter
from typing import Annotated

import typer
from rich.table import Table

from q2r2_control.benchmark.motion_run import PATIENCE, MotionFigures
from q2r2_control.benchmark.peers.base import PEERS, WITHOUT_ACCELERATION_LIMIT
from q2r2_control.benchmark.tick_times import BenchReport, run_bench
from q2r2_control.benchmark.work_bench import WORK_PEERS, WorkReport, WorkRow, run_work_bench
from q2r2_control.benchmark.work_motions import WORK_MOTIONS, motions_named
from q2r2_control.cli.figure_table import Cell, figure_table
from q2r2_control.cli.options import DEMO_CONFIG, Json
from q2r2_control.cli.output import notice_of_compiling, print_progress, print_report, stderr_console
from q2r2_control.config.cell import load_config
from q2r2_control.errors import ConfigError

_TICKS = 3000
_HELD = "held: ticks in which ours executes the certified stop, or a peer has no solution and stands still"
_WORK_NOTES = (
    "RMS, max: distance of the worse tool from its target, from approach to rest; free: RMS of ours in free air",
    "there: time until both tools are within 10 mm of the goal for good; no: they are not at the end",
    _HELD,
    "near: nearest monitored pair; |a|: greatest acceleration of a joint [rad/s^2]",
    "rest: RMS of the joints' acceleration in the last 0.5 s, after 1.5 s of still targets",
    "* has no acceleration limit; (!) not all targets can be reached with every distance kept",
    f"gave up: took more than {PATIENCE:g} times the motion's own time; figures are of the share that was done",
    "peers get their targets ahead by speed / gain, since they have no feed-forward",
)


def bench(
    ticks: Annotated[int | None, typer.Option(min=100, help=f"Of each scenario, {_TICKS} by default.")] = None,
    peers: Annotated[bool, typer.Option(help="Time roboplan, mink and pink too, where they are installed.")] = True,
    work: Annotated[
        bool, typer.Option("--work", help="Measure two-armed work motions: errors, distances, rest, times.")
    ] = False,
    motion: Annotated[
        list[str] | None,
        typer.Option(help="With --work: only this motion, or those that begin with it, such as carry; repeatable."),
    ] = None,
    json: Json = False,
) -> None:
    """Time one tick of the controller with both arms, every pair and the certificate, and public peers beside it.

    With --work: both arms at work near each other and near the table, beside ours in free air, roboplan and mink.
    """
    if motion and not work:
        raise ConfigError("--motion needs --work")
    if work and ticks is not None:
        raise ConfigError("--ticks cannot be used with --work, whose motions have a length of their own")
    motions, config = motions_named(motion or WORK_MOTIONS), load_config(DEMO_CONFIG)
    with notice_of_compiling(stderr_console()):
        if work:
            report = run_work_bench(config, motions, WORK_PEERS if peers else (), print_progress)
            print_report(report.as_json(), (_work_table(report),), json)
        else:
            times = run_bench(config, ticks or _TICKS, tuple(PEERS) if peers else (), print_progress)
            print_report(times.as_json(), (_times_table(times), _motion_table(times)), json)


def _times_table(report: BenchReport) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scenario, group in groupby(report.rows, attrgetter("name")):
        rows.append((scenario,))
        for row in group:
            ratios = ("" if ratio is None else ratio for ratio in (row.median_ratio, row.p99_ratio))
            rows.append((f"  {row.controller}", row.rounds, row.median_us, row.p99_us, row.max_us, *ratios))
    return figure_table(
        f"{report.cell}: one tick of 1 ms with {report.pairs} pairs, each run of {report.rows[0].ticks} ticks",
        ("controller", "runs", "median [us]", "p99 [us]", "max [us]", "median /ours", "p99 /ours"),
        rows,
    )


def _motion_table(report: BenchReport) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for scenario, group in groupby(report.rows, attrgetter("name")):
        rows.append((scenario,))
        for row in group:
            found = row.metrics
            shares = (found.max_acceleration_ratio, found.max_velocity_ratio, f"{found.min_position_margin_rad:.3f}")
            held = found.failures if row.fallback_ticks is None else row.fallback_ticks
            rows.append((f"  {row.controller}", *shares, found.min_distance_mm, held, f"{found.tail_acceleration:.3f}"))
    return figure_table(
        "motion",
        ("controller", "a /limit", "v /limit", "room [rad]", "nearest [mm]", "held", "tail [rad/s^2]"),
        rows,
        [_HELD, *report.notes],
    )


def _work_table(report: WorkReport) -> Table:
    return figure_table(
        f"{report.cell}: work motions in ticks of 1 ms, {report.pairs} pairs",
        (
            *("controller", "RMS [mm]", "max [mm]", "free [mm]", "there [s]", "held [%]"),
            *("near [mm]", "|a| [s-2]", "rest [s-2]", "p50 [us]", "p99 [us]"),
        ),
        _work_rows(report),
        [*(f"{row.motion}: {row.about}" for row in report.rows), *_WORK_NOTES, *report.notes],
    )


def _work_rows(report: WorkReport) -> Iterator[tuple[Cell, ...]]:
    for row in report.rows:
        yield (f"{row.motion}{'' if row.reachable else ' (!)'}",)
        for figures in row.figures:
            yield _work_cells(row, figures)
            if figures.done < 1.0:
                yield (f"  gave up at {100.0 * figures.done:.0f} %",)


def _work_cells(row: WorkRow, figures: MotionFigures) -> tuple[Cell, ...]:
    unlimited = "*" if figures.controller in WITHOUT_ACCELERATION_LIMIT else ""
    held = figures.fallback_percent
    if held is None and figures.ticks:
        held = 100.0 * figures.failures / figures.ticks
    misses = figures.arrival_s is None and row.free_air.arrival_s is not None
    return (
        f"  {figures.controller}{unlimited}",
        figures.rms_error_mm,
        figures.max_error_mm,
        row.free_air.rms_error_mm if figures is row.figures[0] else "",
        "no" if misses else figures.arrival_s,
        held,
        figures.min_distance_mm,
        figures.max_acceleration,
        figures.rest_acceleration,
        figures.median_us,
        figures.p99_us,
    )
