"""The table of ``q2r2 bench --loop``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.loop_times import PHYSICS, LoopReport, StageTime
from q2r2_control.cli.figure_table import figure_table


def loop_table(report: LoopReport) -> Table:
    """Where a tick of the live loop goes: a column for each plant and mode."""
    first = report.rows[0]
    table = figure_table(
        f"{report.cell}: one tick of the live loop at {report.loop_rate_hz:g} Hz, {first.rounds} runs of {first.ticks} "
        "ticks each [us]",
        "stage",
        tuple(text for row in report.rows for text in (f"{row.plant} {row.mode}\nmedian", "\np99")),
    )
    for index, stage in enumerate(first.stages):
        if stage.stage == PHYSICS:
            whole = {"without physics": "without_physics", "the same, recorded": "recorded"}
            until = {"to the command": "to_command", "to it, recorded": "to_command_recorded"}
            for text, name in (whole | until).items():
                if times := [time for row in report.rows if (time := getattr(row, name)) is not None]:
                    table.add_row(Text(text, style="" if "recorded" in text else "bold"), *_times_of(times))
        table.add_row(stage.stage, *_times_of(row.stages[index] for row in report.rows))
    added = ", ".join(f"{row.clocks_us:.0f}" for row in report.rows)
    table.caption = Text(
        f"without physics: of runs without clocks in the stages, which add {added} us; medians do not add up\n"
        "to the command: from the inputs until it is applied, a tick's time in the summary of a run\n"
        "drive: impedance and wall in torque mode; physics: of the simulator, where a real robot would move"
    )
    table.caption_justify = "left"
    return table


def _times_of(stages: Iterable[StageTime]) -> Iterator[str]:
    for stage in stages:
        yield f"{stage.median_us:.0f}"
        yield f"{stage.p99_us:.0f}"
