"""The table of ``q2r2 bench --rest``."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.rest_run import AT_REST, DURATION, JOLT, STARTED, RestReport
from q2r2_control.cli.figure_table import figure_table

_LEGEND = f"""\
targets stay where they are for {DURATION:g} s; most cannot be reached with every distance kept
at rest: acceleration, norm over the joints, RMS over the last 0.5 s, below {AT_REST:g} rad/s^2
jolts: ticks of a run after {STARTED:g} s in which a joint's acceleration changes by more than {JOLT:g} rad/s^2
held: ticks in which the certified stop was executed, in all runs"""


def rest_table(report: RestReport) -> Table:
    """One line a kind of targets."""
    columns = ("runs", "at rest", "median [rad/s^2]", "worst [rad/s^2]", "jolts mean", "jolts most", "held")
    table = figure_table(f"{report.cell}: constant targets, seed {report.seed}", "targets", columns)
    for each in report.figures:
        table.add_row(
            each.kind,
            str(each.runs),
            str(each.at_rest),
            f"{each.median_acceleration:.3f}",
            f"{each.worst_acceleration:.3f}",
            f"{each.jolts:.1f}",
            str(each.most_jolts),
            str(each.fallback_ticks),
        )
    table.caption = Text(_LEGEND)
    table.caption_justify = "left"
    return table
