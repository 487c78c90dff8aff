"""The table of ``q2r2 bench --loop``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.loop_times import LoopReport, LoopRow, Ratio, StageTime
from q2r2_control.benchmark.stage_clock import PHYSICS
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
            for text, times in _sums(report.rows):
                table.add_row(Text(text, style="" if "recorded" in text else "bold"), *_times_of(times))
        table.add_row(stage.stage, *_times_of(row.stages[index] for row in report.rows))
    added = ", ".join(f"{row.clocks_us:.0f}" for row in report.rows)
    caption = (
        f"without physics: of runs without clocks in the stages, which add {added} us; medians do not add up\n"
        "stages: of three runs with clocks\n"
        "to the command: from the inputs until it is applied, a tick's time in the summary of a run\n"
        "back to back: without physics, where no tick waits until it is due\n"
        "drive: impedance and wall in torque mode; physics: of the simulator, where a real robot would move"
    )
    table.caption = Text("\n".join((caption, *_recording_costs(report.rows))))
    table.caption_justify = "left"
    return table


def _sums(rows: Sequence[LoopRow]) -> Iterator[tuple[str, list[StageTime]]]:
    recorded = [row.recording for row in rows if row.recording is not None]
    yield "without physics", [row.without_physics for row in rows]
    if recorded:
        yield "the same, recorded", [cost.without_physics for cost in recorded]
    yield "to the command", [row.to_command for row in rows]
    if recorded:
        yield "to it, recorded", [cost.to_command for cost in recorded]
    yield "back to back", [row.back_to_back for row in rows]


def _recording_costs(rows: Sequence[LoopRow]) -> Iterator[str]:
    recorded = [(row, row.recording) for row in rows if row.recording is not None]
    if recorded:
        yield "p99 with recording to p99 without, to 90 %; then the same to the command:"
    for row, cost in recorded:
        whole, command = _ratio_text(cost.p99_ratio), _ratio_text(cost.to_command_p99_ratio)
        yield f"  {row.plant}, {row.mode}: {whole}; {command}"


def _ratio_text(ratio: Ratio) -> str:
    return f"{ratio.value:.2f} ({ratio.low:.2f}-{ratio.high:.2f})"


def _times_of(stages: Iterable[StageTime]) -> Iterator[str]:
    for stage in stages:
        yield f"{stage.median_us:.0f}"
        yield f"{stage.p99_us:.0f}"
