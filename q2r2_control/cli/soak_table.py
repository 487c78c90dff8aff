"""The table of ``q2r2 bench --soak``."""

from __future__ import annotations

import math

from rich.table import Table
from rich.text import Text

from q2r2_control.cli.figure_table import figure_table
from q2r2_control.verification.soak import MEMORY_ALLOWED, SoakReport


def soak_table(report: SoakReport) -> Table:
    """Worst margin of every promise, and how often it was broken."""
    table = figure_table(
        f"{report.cell}: {report.ticks} hostile ticks, {report.simulated_s:.0f} s, seed {report.seed}",
        "promise",
        ("worst", "allowed", "checked", "broken"),
    )
    for margin in report.margins:
        unit = f" {margin.unit}" if margin.unit else ""
        worst = "" if math.isinf(margin.worst) and not margin.violations else f"{margin.worst:.2g}{unit}"
        allowed = f"{margin.sense} {margin.allowed:.2g}"
        style = "red" if margin.violations else None
        table.add_row(Text(margin.name), worst, allowed, str(margin.checked), str(margin.violations), style=style)
    if report.memory_growth_mb is not None:
        grown, broken = f"{report.memory_growth_mb:.2f} MB", str(int(report.memory_growth_mb > MEMORY_ALLOWED))
        table.add_row("memory growth after a tenth of it", grown, f"<= {MEMORY_ALLOWED:g}", "1", broken)
    table.caption = Text(_soak_notes(report))
    table.caption_justify = "left"
    return table


def _soak_notes(report: SoakReport) -> str:
    lines = [
        f"{report.segments} segments, {report.resets} resets, {report.solver_faults} ticks with a failing solver,"
        f" {report.fallbacks} stops ({report.fallbacks_healthy} with a healthy solver),"
        f" {report.openings} openings of grippers ({report.openings_refused} refused)"
        + (f", {report.grasps} grasps and releases" if report.grasps else "")
        + f", {report.changes} changes of settings"
    ]
    for found in report.broken:
        error = f": {found.error}" if found.error else ""
        lines.append(
            f"first broken at tick {found.tick}: {found.promise}{error}"
            f" [tick {found.since_segment} of: {found.segment}; dt {found.dt}]"
        )
    if report.broken:
        lines.append(
            f"to see the first again: q2r2 bench --soak --seed {report.seed} --ticks {report.broken[0].tick + 1}"
        )
    return "\n".join(lines)
