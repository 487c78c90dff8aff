"""The table of ``q2r2 bench --press``."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from q2r2_control.benchmark.press_run import COMMANDED, PressFigures
from q2r2_control.cli.figure_table import figure_table

_LEGEND = """\
touch: speed of the tool when it first touches, and the greatest force in the 0.25 s after it
stays: mean force of the table; spring: stiffness times the tool's way from its reference; bound: times depth allowed
bounce: time without contact until the slide; slides: mean force, extremes and time without contact until the lift
lag: of the tool at the slide's end, and friction times mean force over stiffness, which it has to be
chatters: friction from which the slide is unstable on a contact of 100 kN/m (a rubber pad) or 1 MN/m (bare metal);
    damped: with impedance.damping_ratio 2
rotor share: of the rotors' inertia that the joints feel (mujoco.rotor_share); friction: mujoco.obstacle_friction"""


def press_table(cell: str, figures: Sequence[PressFigures]) -> Table:
    """One column a press."""
    title = f"{cell}: {1e3 * COMMANDED:g} mm commanded into the table, torque mode, MuJoCo"
    table = figure_table(title, "slides", tuple(f"{press.slide}" for press in figures))
    rows = {
        "rotor share": [f"{press.rotor_share:g}" for press in figures],
        "friction": [f"{press.friction:g}" for press in figures],
        "touch, speed [mm/s]": [f"{1e3 * press.impact_speed:.0f}" for press in figures],
        "touch, force [N]": [f"{press.impact_force:.0f}" for press in figures],
        "stays [N]": [f"{press.steady_force:.1f}" for press in figures],
        "spring [N]": [f"{press.spring_force:.1f}" for press in figures],
        "bound [N]": [f"{press.bound:.1f}" for press in figures],
        "bounce [s]": [f"{press.bounce_s:.3f}" for press in figures],
        "slides [N]": [f"{press.slide_force:.1f}" for press in figures],
        "slides, least [N]": [f"{press.slide_least:.1f}" for press in figures],
        "slides, largest [N]": [f"{press.slide_largest:.1f}" for press in figures],
        "without contact [s]": [f"{press.lost_contact_s:.3f}" for press in figures],
        "lag [mm]": [f"{press.slide_error_mm:.1f}" for press in figures],
        "lag, friction [mm]": [f"{press.friction_lag_mm:.1f}" for press in figures],
        "chatters, pad": [_from(press.pad_chatter) for press in figures],
        "chatters, metal": [_from(press.metal_chatter) for press in figures],
        "chatters, pad, damped": [_from(press.pad_chatter_damped) for press in figures],
        "chatters, metal, damped": [_from(press.metal_chatter_damped) for press in figures],
        "largest force [N]": [f"{press.largest_force:.0f}" for press in figures],
        "promises broken": [str(press.violations) for press in figures],
    }
    for name, cells in rows.items():
        table.add_row(Text(name), *cells)
    table.caption = Text(_LEGEND)
    table.caption_justify = "left"
    return table


def _from(friction: float) -> str:
    return f"{friction:g}" if math.isfinite(friction) else "> 2"
