"""``q2r2 soak``: every promise of the controller under hostile input."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

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
from q2r2_control.verification.fault_injection import FINGERS, with_contact
from q2r2_control.verification.soak import COUNTED, MEMORY_ALLOWED, SoakReport, run_soak

_TICKS = 1_000_000


def soak(
    ticks: Annotated[int, typer.Option(min=100, help="How many.")] = _TICKS,
    contact: Annotated[bool, typer.Option("--contact", help="Fingers may touch table and fingers.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of all that is drawn at random.")] = 0,
    json: Json = False,
) -> None:
    """Check every promise of the controller in random hostile targets, ticks, starts and solver failures.

    Prints the worst margin of each promise. Exit 1 if one was broken.
    """
    config = load_config(DEMO_CONFIG)
    with notice_of_compiling(stderr_console()):
        report = run_soak(with_contact(config, FINGERS) if contact else config, ticks, seed, print_progress)
    print_report(report.as_json(), (soak_table(report, "--contact " if contact else ""),), json)
    raise typer.Exit(0 if report.passed else 1)


def soak_table(report: SoakReport, options: str = "") -> Table:
    """Worst margin of every promise, and how often it was broken; ``options`` are those that lead to the same run."""
    return figure_table(
        f"{report.cell}: {report.ticks} hostile ticks, {report.simulated_s:.0f} s, seed {report.seed}",
        ("promise", "worst", "allowed", "checked", "broken"),
        _rows(report),
        list(_notes(report, options)),
    )


def _rows(report: SoakReport) -> Iterator[tuple[Cell, ...]]:
    for margin in report.margins:
        name = Text(margin.name, style="red" if margin.violations else "")
        worst = "" if math.isinf(margin.worst) and not margin.violations else f"{margin.worst:.2g} {margin.unit}"
        yield name, worst, f"{margin.sense} {margin.allowed:.2g}", margin.checked, margin.violations
    if (grown := report.memory_growth_mb) is not None:
        broken = int(grown > MEMORY_ALLOWED)
        yield "memory growth after a tenth of it", f"{grown:.2f} MB", f"<= {MEMORY_ALLOWED:g}", 1, broken


def _notes(report: SoakReport, options: str) -> Iterator[str]:
    yield ", ".join(f"{report.counts[name]} {what}" for name, what in COUNTED.items())
    for found in report.broken:
        error = f": {found.error}" if found.error else ""
        where = f"tick {found.since_segment} of: {found.segment}; dt {found.dt}"
        yield f"first broken at tick {found.tick}: {found.promise}{error} [{where}]"
    if report.broken:
        again = f"{options}--seed {report.seed} --ticks {report.broken[0].tick + 1}"
        yield f"to see the first again: q2r2 soak {again}"
