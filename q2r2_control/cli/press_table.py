"""The table of ``q2r2 bench --press``."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.press_run import COMMANDED, PressFigures
from q2r2_control.cli.figure_table import figure_table

_LEGEND = """\
touch: speed of the tool when it first touches, and the greatest force in the 0.25 s after it
stays: mean force of the table; spring: stiffness times the tool's way from its reference; bound: times depth allowed
bounce: time without contact until the slide; slides: mean force, time without contact, way that the tool lags behind
rotor share: of the rotors' inertia that the joints feel (mujoco.rotor_share)"""


def press_table(cell: str, figures: Sequence[PressFigures]) -> Table:
    """One column a press."""
    title = f"{cell}: {1e3 * COMMANDED:g} mm commanded into the table, torque mode, MuJoCo"
    table = figure_table(title, "", tuple(f"rotor share {press.rotor_share:g}" for press in figures))
    rows = {
        "touch, speed [mm/s]": [f"{1e3 * press.impact_speed:.0f}" for press in figures],
        "touch, force [N]": [f"{press.impact_force:.0f}" for press in figures],
        "stays [N]": [f"{press.steady_force:.1f}" for press in figures],
        "spring [N]": [f"{press.spring_force:.1f}" for press in figures],
        "bound [N]": [f"{press.bound:.1f}" for press in figures],
        "bounce [s]": [f"{press.bounce_s:.3f}" for press in figures],
        "slides [N]": [f"{press.slide_force:.1f}" for press in figures],
        "slides, without contact [s]": [f"{press.lost_contact_s:.3f}" for press in figures],
        "slides, lag [mm]": [f"{press.slide_error_mm:.1f}" for press in figures],
        "largest force [N]": [f"{press.largest_force:.0f}" for press in figures],
        "promises broken": [str(press.violations) for press in figures],
    }
    for name, cells in rows.items():
        table.add_row(Text(name), *cells)
    table.caption = Text(_LEGEND)
    table.caption_justify = "left"
    return table
