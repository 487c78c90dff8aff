"""``q2r2 run``: a cell with an input and a plant of the user's choice."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from q2r2_control.cli.cell_run import RunOptions, print_summary, run_cell
from q2r2_control.cli.headset_check import Host, Port, with_address
from q2r2_control.cli.output import (
    ConfigFile,
    Headless,
    Human,
    Json,
    Operator,
    RealTime,
    Record,
    Seed,
    Task,
    Viewer,
    notes_of,
    positive,
    shows_table,
    stderr_console,
)
from q2r2_control.config.cell import load_config
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.scripted import DEFAULT_TRAJECTORY, TRAJECTORIES
from q2r2_control.plugins import INPUTS, check_installed
from q2r2_control.types import CommandMode


def run(
    config: ConfigFile,
    input: Annotated[
        str | None, typer.Option(metavar="NAME", help="An installed input; without it, the cell's.")
    ] = None,
    plant: Annotated[
        str | None, typer.Option(metavar="NAME", help="An installed plant; without it, the cell's.")
    ] = None,
    mode: Annotated[CommandMode, typer.Option(help="What the plant gets; torque: arms that yield.")] = (
        CommandMode.POSITION
    ),
    duration: Annotated[float | None, typer.Option(help="[s]; without it, until Ctrl-C.")] = None,
    fast: Annotated[bool, typer.Option("--fast", help="Simulated time, as fast as it can, repeatable.")] = False,
    trajectory: Annotated[str | None, typer.Option(help=f"Scripted: {', '.join(TRAJECTORIES)}.")] = None,
    human: Human = False,
    seed: Seed = 0,
    host: Host = None,
    port: Port = None,
    viewer: Viewer = False,
    headless: Headless = False,
    rt: RealTime = False,
    record: Record = None,
    task: Task = None,
    operator: Operator = None,
    force: Annotated[bool, typer.Option("--force", help="Run even where q2r2 check finds a fault.")] = False,
    json: Json = False,
) -> None:
    """Run a cell until the duration is over or Ctrl-C; both bring the arms to rest first.

    A cell in which q2r2 check finds a fault is refused with the same line and exit code 2, unless --force is given.
    With the headset, one line on stderr says which address was bound: "headset: listening on HOST:PORT".
    """
    scripted_only = {"--trajectory": trajectory is not None, "--human": human, "--fast": fast, "--seed": seed != 0}
    headset_only = {"--host": host is not None, "--port": port is not None}
    cell = load_config(config)
    source = input or cell.input
    check_installed(INPUTS, source)
    unfit = ({} if source == "scripted" else scripted_only) | ({} if source == "headset" else headset_only)
    for option, given in unfit.items():
        if given:
            raise ConfigError(f"{option} cannot be used with --input {source}")
    if fast and duration is None:
        raise ConfigError("--fast needs --duration, since simulated time has no end of its own")
    if fast and rt:
        raise ConfigError("--rt and --fast exclude each other, since simulated time is never late")
    notes = notes_of(task, operator, record)
    cell = with_address(cell, host, port)
    options = RunOptions(
        name=cell.name,
        input=source,
        plant=plant or cell.plant,
        mode=mode.value,
        duration=None if duration is None else positive("--duration", duration),
        fast=fast,
        trajectory=trajectory or DEFAULT_TRAJECTORY,
        human=human,
        seed=seed,
        table=shows_table(headless, viewer),
        window=viewer,
        force=force,
        real_time=rt,
        record=None if record is None else Path(record),
        notes=notes,
    )
    print_summary(run_cell(cell, options, stderr_console()), json)
