"""``q2r2 demo``: two simulated arms follow scripted hands."""

from __future__ import annotations

from typing import Annotated

import typer

from q2r2_control.cli.cell_run import RunOptions, print_summary, run_cell
from q2r2_control.cli.options import DEMO_CONFIG, Headless, Human, Json, RealTime, Viewer, positive, shows_table
from q2r2_control.cli.output import stderr_console
from q2r2_control.config import load_config
from q2r2_control.inputs.factory import DEFAULT_TRAJECTORY


def demo(
    duration: Annotated[float, typer.Option(help="[s]")] = 20.0,
    viewer: Viewer = False,
    headless: Headless = False,
    human: Human = False,
    rt: RealTime = False,
    json: Json = False,
) -> None:
    """Two simulated arms follow scripted hands: both pick up a block, meet in the middle, put it back.

    The arms are driven in torque mode, by Cartesian impedance. Writes plots and a summary to a folder under runs/.
    """
    options = RunOptions(
        name="demo",
        input="scripted",
        plant="mujoco",
        mode="torque",
        duration=positive("--duration", duration),
        fast=False,
        trajectory=DEFAULT_TRAJECTORY,
        human=human,
        seed=0,
        table=shows_table(headless, viewer),
        window=viewer,
        report=True,
        force=False,
        real_time=rt,
    )
    print_summary(run_cell(load_config(DEMO_CONFIG), options, stderr_console()), json)
