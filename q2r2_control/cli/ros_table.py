"""Tables of ``q2r2 bench --ros``."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.command_responses import LatencyReport
from q2r2_control.benchmark.node_load import LoadReport
from q2r2_control.benchmark.press_times import WATCHED, PressReport
from q2r2_control.cli.figure_table import figure_table


def latency_table(report: LatencyReport) -> Table:
    """Latencies through the ROS nodes."""
    table = figure_table(
        f"from an input topic to the joint command that answers it, controller at {report.loop_rate_hz:g} Hz",
        "path",
        ("p50 [ms]", "p99 [ms]", "max [ms]", "steps", "missed"),
    )
    for row in report.rows:
        times = ("" if time is None else f"{time:.1f}" for time in (row.p50_ms, row.p99_ms, row.max_ms))
        table.add_row(row.path, *times, str(row.steps), str(row.missed))
    table.caption = Text(
        f"one joint command between two processes: p50 {report.transport_p50_ms:.2f} ms, p99 "
        f"{report.transport_p99_ms:.2f} ms\n"
        "the hand's latency includes an interpolation of 5 ms, the shortest; its filters are off"
    )
    table.caption_justify = "left"
    return table


def presses_table(report: PressReport) -> Table:
    """What follows a press, the first time and later."""
    table = figure_table(
        f"from a press until the arm moves; starts of the nodes: {report.starts}",
        "",
        tuple(f"{row.press} {figure} [ms]" for row in report.rows for figure in ("p50", "max")),
    )
    for what, name in (("longest tick", "tick"), ("until the first target", "target"), ("until it moves", "motion")):
        times = (getattr(row, f"{name}_{figure}_ms") for row in report.rows for figure in ("p50", "max"))
        table.add_row(what, *("" if time is None else f"{time:.1f}" for time in times))
    counts = ", ".join(f"{row.count} {row.press}" for row in report.rows)
    table.caption = Text(
        f"presses: {counts}; not answered: {sum(row.unanswered for row in report.rows)}\n"
        f"longest tick: of the arm's node, until its next one, within {WATCHED:g} s of the press; "
        f"usually {report.period_ms:.1f} ms"
    )
    table.caption_justify = "left"
    return table


def load_table(report: LoadReport) -> Table:
    """What the set of nodes takes of the processors."""
    table = figure_table(
        f"the nodes of q2r2 ros up at their default rates, {report.seconds:g} s each",
        "node",
        ("idle [% of a core]", "moving [% of a core]"),
    )
    for row in (*report.rows, report.total):
        table.add_row(row.node, f"{row.idle:.0f}", f"{row.moving:.0f}", end_section=row is report.rows[-1])
    table.caption = Text(
        f"moving: {report.commands_hz:.0f} joint commands a second; their speeds ripple by "
        f"{100.0 * report.speed_ripple:.1f} % RMS while both hands go round circles, "
        f"with samples up to {1e3 * report.jitter:g} ms late"
    )
    table.caption_justify = "left"
    return table
