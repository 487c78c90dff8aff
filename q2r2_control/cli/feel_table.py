"""The table of ``q2r2 bench --feel``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from rich.console import Console
from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.feel_run import (
    BAND,
    BAND_RMS,
    MOTIONS,
    NOISE,
    REACHES,
    SLOWLY,
    STOP_SPEED,
    STOP_TIME,
    TREMOR,
    TREMORS,
    FeelFigures,
)
from q2r2_control.cli.figure_table import figure_table
from q2r2_control.cli.output import as_json_text

_REACH = (
    f"{min(r[0] for r in REACHES):g} to {max(r[0] for r in REACHES):g} m in "
    f"{min(r[1] for r in REACHES):g} to {max(r[1] for r in REACHES):g} s"
)
_LEGEND = f"""\
all from the hand to the measured tool, from samples at 72 to 76 Hz to an arm in MuJoCo, position mode
filter: delay as its settings say; tremor: {1e3 * TREMOR:g} mm of a hand that moves at {1e3 * SLOWLY:g} mm/s, or rests
reaches: {_REACH} of least jerk, by correlation of velocities
tremor of {BAND[0]:g} to {BAND[1]:g} Hz: {1e3 * BAND_RMS:g} mm RMS, flat in the band; all that it does to the tool
noise: RMS of the tool, for {1e6 * NOISE:g} um a sample
stop: of a hand at {STOP_SPEED:g} m/s that stops in {STOP_TIME:g} s, until the tool is within 2 mm of its rest;
beyond: how far it went past it"""


def show_feel(cell: str, figures: Sequence[FeelFigures], json: bool) -> None:
    """Print the figures of ``cell`` as a table, or as JSON."""
    if json:
        print(as_json_text({"cell": cell, "filters": [asdict(each) for each in figures]}))
    else:
        Console().print(feel_table(cell, figures))


def feel_table(cell: str, figures: Sequence[FeelFigures]) -> Table:
    """One column a filter."""
    table = figure_table(f"{cell}: what an operator feels of a filter", "", tuple(each.name for each in figures))
    rows = {"filter [ms]": [f"{each.filter_delay_ms:.0f}" for each in figures]}
    for index, (frequency, amplitude) in enumerate(MOTIONS):
        tone = f"{frequency:g} Hz, {1e3 * amplitude:g} mm"
        rows[f"{tone}: delay [ms]"] = [f"{each.delays_ms[index]:.1f}" for each in figures]
        rows[f"{tone}: gain [dB]"] = [f"{each.gains_db[index]:.1f}" for each in figures]
    rows["reaches: delay [ms]"] = [f"{each.reach_delay_ms:.1f}" for each in figures]
    rows["the latest of them [ms]"] = [f"{each.worst_reach_delay_ms:.1f}" for each in figures]
    for index, frequency in enumerate(TREMORS):
        rows[f"tremor of {frequency:g} Hz [dB]"] = [f"{each.tremors_db[index]:.1f}" for each in figures]
    rows["tremor at rest [dB]"] = [f"{each.tremor_at_rest_db:.1f}" for each in figures]
    band = f"tremor of {BAND[0]:g} to {BAND[1]:g} Hz"
    rows[f"{band} [dB]"] = [f"{each.band_db:.1f}" for each in figures]
    rows[f"{band}, hand held [dB]"] = [f"{each.band_at_rest_db:.1f}" for each in figures]
    rows["noise at rest [um]"] = [f"{each.noise_um:.0f}" for each in figures]
    rows["stop: delay [ms]"] = [f"{each.stop_delay_ms:.0f}" for each in figures]
    rows["stop: beyond [mm]"] = [f"{each.overshoot_mm:.2f}" for each in figures]
    for name, cells in rows.items():
        table.add_row(Text(name), *cells)
    table.caption = Text(_LEGEND)
    table.caption_justify = "left"
    return table
