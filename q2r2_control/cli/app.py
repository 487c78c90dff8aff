"""The ``q2r2`` command."""

from __future__ import annotations

import logging
import math
import sys
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from q2r2_control.cli.bench import bench
from q2r2_control.cli.cell_report import check_cell, write_model_pairs, write_pairs
from q2r2_control.cli.cell_run import AnnouncedHeadset, RunOptions, notice_of_compiling
from q2r2_control.cli.cell_run import run as run_cell
from q2r2_control.cli.json_output import as_json_text
from q2r2_control.cli.one_line_errors import OneLineErrors
from q2r2_control.cli.progress_lines import ProgressLines
from q2r2_control.cli.ros import app as ros_app
from q2r2_control.cli.tables import (
    arm_table,
    headset_table,
    model_pairs_table,
    obstacle_table,
    pair_reach_table,
    pair_table,
    summary_table,
)
from q2r2_control.config.cell import Config, HeadsetConfig, load_config
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.headset_check import watch_headset
from q2r2_control.inputs.trajectories import TRAJECTORIES
from q2r2_control.pipeline import DEFAULT_TRAJECTORY
from q2r2_control.runtime.run_summary import RunSummary
from q2r2_control.types import CommandMode
from q2r2_control.viewer.live import HeadsetDisplay

DEMO_CONFIG = "config/dual_iiwa7.yaml"

app = typer.Typer(
    cls=OneLineErrors,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Bimanual VR teleoperation: a headset's hands move two robot arms, safely.",
)
app.add_typer(ros_app, name="ros")
app.command(epilog="Example: q2r2 bench --ticks 20000, q2r2 bench --soak --seed 3, or q2r2 bench --ros")(bench)


class InputName(StrEnum):
    """Where hand samples come from."""

    SCRIPTED = "scripted"
    HEADSET = "headset"


class PlantName(StrEnum):
    """What moves."""

    MUJOCO = "mujoco"
    KINEMATIC = "kinematic"


ConfigFile = Annotated[str, typer.Argument(metavar="CONFIG", help="The cell's YAML, such as config/dual_iiwa7.yaml.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and all else on stderr.")]
Headless = Annotated[bool, typer.Option("--headless", help="No live table, no window.")]
Viewer = Annotated[bool, typer.Option("--viewer", help="Open MuJoCo's window; closing it ends the run.")]
Human = Annotated[bool, typer.Option("--human", help="Scripted hands tremble, and samples get lost and late.")]
Host = Annotated[str | None, typer.Option(help="Address to bind, instead of the config's; 0.0.0.0: every network.")]
Port = Annotated[int | None, typer.Option(min=0, max=65535, help="Port, instead of the config's; 0: any free one.")]


class _StderrHandler(logging.Handler):
    """Writes to what stderr is at the time, so that lines appear above a live table and not across it."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr)


@app.callback()
def main() -> None:
    """Set up what all commands share."""
    logger = logging.getLogger("q2r2_control")
    if not logger.handlers:
        logger.addHandler(_StderrHandler())
        logger.setLevel(logging.INFO)


@app.command(epilog="Example: q2r2 demo --viewer")
def demo(
    duration: Annotated[float, typer.Option(help="[s]")] = 20.0,
    viewer: Viewer = False,
    headless: Headless = False,
    human: Human = False,
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
        duration=_positive("--duration", duration),
        fast=False,
        trajectory=DEFAULT_TRAJECTORY,
        human=human,
        seed=0,
        table=_table(headless, viewer),
        window=viewer,
        report=True,
    )
    _show(run_cell(load_config(DEMO_CONFIG), options, _stderr()), json)


@app.command(epilog="Example: q2r2 run config/dual_iiwa7.yaml --input headset --host 0.0.0.0")
def run(
    config: ConfigFile,
    input: Annotated[InputName, typer.Option(help="Where hand samples come from.")] = InputName.SCRIPTED,
    plant: Annotated[PlantName, typer.Option(help="What moves.")] = PlantName.MUJOCO,
    mode: Annotated[CommandMode, typer.Option(help="What the plant gets; torque: arms that yield.")] = (
        CommandMode.POSITION
    ),
    duration: Annotated[float | None, typer.Option(help="[s]; without it, until Ctrl-C.")] = None,
    fast: Annotated[bool, typer.Option("--fast", help="Simulated time, as fast as it can, repeatable.")] = False,
    trajectory: Annotated[str | None, typer.Option(help=f"Scripted: {', '.join(TRAJECTORIES)}.")] = None,
    human: Human = False,
    seed: Annotated[int, typer.Option(min=0, help="Of what --human adds.")] = 0,
    host: Host = None,
    port: Port = None,
    viewer: Viewer = False,
    headless: Headless = False,
    report: Annotated[bool, typer.Option(help="Write plots and a summary to a folder under runs/.")] = False,
    json: Json = False,
) -> None:
    """Run a cell until the duration is over or Ctrl-C; both bring the arms to rest first.

    With the headset, one line on stderr says which address was bound: "headset: listening on HOST:PORT".
    """
    scripted_only = {"--trajectory": trajectory is not None, "--human": human, "--fast": fast, "--seed": seed != 0}
    headset_only = {"--host": host is not None, "--port": port is not None}
    unfit = headset_only if input is InputName.SCRIPTED else scripted_only
    for option, given in unfit.items():
        if given:
            raise ConfigError(f"{option} cannot be used with --input {input.value}")
    if fast and duration is None:
        raise ConfigError("--fast needs --duration, since simulated time has no end of its own")
    cell = _with_address(load_config(config), host, port)
    options = RunOptions(
        name=cell.name,
        input=input.value,
        plant=plant.value,
        mode=mode.value,
        duration=None if duration is None else _positive("--duration", duration),
        fast=fast,
        trajectory=trajectory or DEFAULT_TRAJECTORY,
        human=human,
        seed=seed,
        table=_table(headless, viewer),
        window=viewer,
        report=report,
    )
    _show(run_cell(cell, options, _stderr()), json)


@app.command(epilog="Example: q2r2 check config/dual_iiwa7.yaml --pairs dual_iiwa7.srdf")
def check(
    config: ConfigFile,
    pairs: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Find pairs that can never meet and write them as an SRDF for the key srdf."),
    ] = None,
    model_pairs: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Find such pairs of each arm and tool alone, and write ARM.srdf and so on."
        ),
    ] = None,
    samples: Annotated[int, typer.Option(help="Random postures that --pairs and --model-pairs look at.")] = 20_000,
    clearance: Annotated[float, typer.Option(help="Pairs that stay farther apart need no watching [m].")] = 0.05,
    json: Json = False,
) -> None:
    """Validate a cell and print its arms, limits, obstacles and distances at home; exit 1 where home is unsafe."""
    if pairs is not None and model_pairs is not None:
        raise ConfigError("--pairs and --model-pairs exclude each other")
    if pairs is not None:
        found = write_pairs(load_config(config), pairs, samples, clearance, progress=ProgressLines(_stderr()))
        _print(asdict(found), pair_reach_table(found), json)
        return
    if model_pairs is not None:
        files = write_model_pairs(
            load_config(config), model_pairs, samples, clearance, progress=ProgressLines(_stderr())
        )
        _print(files, model_pairs_table(files), json)
        return
    result = check_cell(load_config(config), notice_of_compiling(_stderr()))
    if json:
        print(as_json_text(result.as_json()))
    else:
        console = Console()
        console.print(f"cell {result.name}", highlight=False)
        for table in (*map(arm_table, result.arms), obstacle_table(result), pair_table(result)):
            console.print(table)
        for arm, line in (result.driven or {"arms": "the built-in controller"}).items():
            console.print(f"{arm} driven by {line}", highlight=False, markup=False, soft_wrap=True)
        for note in result.notes:
            console.print(f"NOTE {note}", highlight=False, markup=False, soft_wrap=True)
        for fault in result.faults:
            console.print(f"FAULT {fault}", style="red", highlight=False, soft_wrap=True)
    raise typer.Exit(1 if result.faults else 0)


@app.command("headset-check", epilog="Example: q2r2 headset-check --host 0.0.0.0")
def headset_check(
    config: Annotated[str, typer.Argument(metavar="[CONFIG]", help="Whose address and teleop.axes to use.")] = (
        DEMO_CONFIG
    ),
    host: Host = None,
    port: Port = None,
    duration: Annotated[float | None, typer.Option(help="[s]; without it, until Ctrl-C.")] = None,
    json: Json = False,
) -> None:
    """Show what a headset sends: connection, rates, ages, last values, and which way each hand moves.

    Move a hand forwards, to the left, up: where the words do not agree, change teleop.axes in the config.
    Exit 1 when no hand data came at all.
    """
    cell = _with_address(load_config(config), host, port)
    if duration is not None:
        _positive("--duration", duration)
    console = _stderr()
    server = AnnouncedHeadset(cell, console)
    server.start()
    try:
        with HeadsetDisplay(console) as display:
            check = watch_headset(server, cell, duration, display.show)
    finally:
        server.close()
    if json:
        print(as_json_text(check.as_json()))
    else:
        Console().print(headset_table(check))
    raise typer.Exit(0 if check.heard else 1)


def _with_address(config: Config, host: str | None, port: int | None) -> Config:
    """The config with another address for the headset to connect to."""
    address = HeadsetConfig(
        host=config.headset.host if host is None else host, port=config.headset.port if port is None else port
    )
    return config.model_copy(update={"headset": address})


def _positive(option: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"{option} {value:g}: allowed: a positive number of seconds")
    return value


def _table(headless: bool, viewer: bool) -> bool:
    """Whether to show the live table."""
    if headless and viewer:
        raise ConfigError("--headless and --viewer exclude each other")
    return not headless and sys.stderr.isatty()


def _stderr() -> Console:
    return Console(stderr=True)


def _show(summary: RunSummary, json: bool) -> None:
    _print(summary.as_json(), summary_table(summary), json)


def _print(data: dict[str, Any], table: Table, json: bool) -> None:
    if json:
        print(as_json_text(data))
    else:
        Console().print(table)
