"""``q2r2 bench``: the controller beside public ones, on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import typer
from rich.table import Table

from q2r2_control.benchmark.bench import BenchReport, BenchRow, run_bench
from q2r2_control.benchmark.motion_run import PATIENCE, MotionFigures
from q2r2_control.benchmark.peers.base import PEERS, WITHOUT_ACCELERATION_LIMIT
from q2r2_control.benchmark.work_motions import TIMED_MOTIONS, WORK_MOTIONS, motions_named
from q2r2_control.cli.output import (
    DEMO_CONFIG,
    Cell,
    Json,
    figure_table,
    notice_of_compiling,
    print_progress,
    print_report,
    stderr_console,
)
from q2r2_control.config.cell import load_config
from q2r2_control.errors import ConfigError

_ROUNDS = 3
_NOTES = (
    "p50, p99: time of a tick",
    "RMS: distance of the worse tool from its target, from approach to rest; free: RMS of ours in free air",
    "there: time until both tools are within 10 mm of the goal for good; no: they are not at the end",
    "held: ticks in which ours executes the certified stop, or a peer has no solution and stands still",
    "near: nearest monitored pair; |a|: greatest acceleration of a joint [rad/s^2]",
    "rest: RMS of the joints' acceleration in the last 0.5 s",
    "* has no acceleration limit; (!) not all targets can be reached with every distance kept",
    f"gave up: took more than {PATIENCE:g} times the motion's own time; figures are of the share that was done",
    "peers get their targets ahead by speed / gain, since they have no feed-forward",
)


def bench(
    rounds: Annotated[int | None, typer.Option(min=1, help=f"How often: {_ROUNDS}, with --work 1.")] = None,
    peers: Annotated[bool, typer.Option(help="Measure roboplan, mink and pink too, where they are installed.")] = True,
    work: Annotated[
        bool, typer.Option("--work", help="Two-armed work motions instead of a circle and a contact.")
    ] = False,
    motion: Annotated[
        list[str] | None,
        typer.Option(help="With --work: only this motion, or those that begin with it, such as carry; repeatable."),
    ] = None,
    json: Json = False,
) -> None:
    """Time one tick of the controller with both arms, every pair and the certificate, and public peers beside it.

    Also measured are errors, distances, rest and certified stops, beside ours in free air.
    """
    if motion and not work:
        raise ConfigError("--motion needs --work")
    motions = motions_named(motion or WORK_MOTIONS) if work else TIMED_MOTIONS
    names = tuple(PEERS) if peers else ()
    with notice_of_compiling(stderr_console()):
        report = run_bench(load_config(DEMO_CONFIG), motions, names, rounds or (1 if work else _ROUNDS), print_progress)
    print_report(report.as_json(), (bench_table(report),), json)


def bench_table(report: BenchReport) -> Table:
    """A row for each controller under each motion."""
    return figure_table(
        f"{report.cell}: ticks of 1 ms, {report.pairs} pairs, rounds: {report.rounds}",
        (
            *("controller", "p50 [us]", "p99 [us]", "RMS [mm]", "free [mm]", "there [s]"),
            *("held [%]", "near [mm]", "|a| [s-2]", "rest [s-2]"),
        ),
        _rows(report),
        [*(f"{row.motion}: {row.about}" for row in report.rows), *_NOTES, *report.notes],
    )


def _rows(report: BenchReport) -> Iterator[tuple[Cell, ...]]:
    for row in report.rows:
        yield (f"{row.motion}{'' if row.reachable else ' (!)'}",)
        for figures in row.figures:
            yield _cells(row, figures)
            if figures.done < 1.0:
                yield (f"  gave up at {100.0 * figures.done:.0f} %",)


def _cells(row: BenchRow, figures: MotionFigures) -> tuple[Cell, ...]:
    unlimited = "*" if figures.controller in WITHOUT_ACCELERATION_LIMIT else ""
    held = figures.fallback_percent
    if held is None and figures.ticks:
        held = 100.0 * figures.failures / figures.ticks
    misses = figures.arrival_s is None and row.free_air.arrival_s is not None
    return (
        f"  {figures.controller}{unlimited}",
        *(figures.times_us or (None, None))[:2],
        figures.rms_error_mm,
        row.free_air.rms_error_mm if figures is row.figures[0] else "",
        "no" if misses else figures.arrival_s,
        held,
        figures.min_distance_mm,
        figures.max_acceleration,
        figures.rest_acceleration,
    )
