"""``q2r2 demo``: two simulated arms do small assembly work, led by scripted hands."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from q2r2_control.cli.cell_run import RunOptions, print_summary, run_cell
from q2r2_control.cli.output import (
    DEMO_CONFIG,
    Headless,
    Human,
    Json,
    RealTime,
    Record,
    Seed,
    Viewer,
    positive,
    shows_table,
    stderr_console,
)
from q2r2_control.config.cell import load_config
from q2r2_control.demo.assembly_tasks import ALL_TASKS, TASKS, tasks_named
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.scripted import trajectory_named
from q2r2_control.types import CommandMode

_DEFAULT = ["handover", "stack"]
_ABOUT = "; ".join(f"{task.name}: {task.about}" for task in TASKS.values())


def demo(
    tasks: Annotated[
        list[str] | None,
        typer.Argument(
            metavar=f"[{'|'.join((*TASKS, ALL_TASKS))}]...", help=f"By default {' '.join(_DEFAULT)}. {_ABOUT}."
        ),
    ] = None,
    mode: Annotated[CommandMode, typer.Option(help="What the arms get; torque: arms that yield.")] = CommandMode.TORQUE,
    duration: Annotated[float | None, typer.Option(help="Ends earlier [s].")] = None,
    fast: Annotated[bool, typer.Option("--fast", help="Simulated time, as fast as it can, repeatable.")] = False,
    viewer: Viewer = False,
    headless: Headless = False,
    human: Human = False,
    seed: Seed = 0,
    record: Record = None,
    rt: RealTime = False,
    json: Json = False,
) -> None:
    """Two simulated arms hand a bar to each other and stack blocks, led by nothing but the samples of scripted hands.

    Ends with a line for each task, as the simulation measured it, and exit code 1 where one did not succeed.
    With --record, whether all succeeded is in the recording, of which q2r2 report makes plots.
    """
    if fast and rt:
        raise ConfigError("--rt and --fast exclude each other, since simulated time is never late")
    chosen = tasks_named(tasks or _DEFAULT)
    trajectory = "+".join(task.name for task in chosen)
    options = RunOptions(
        name="demo",
        input="scripted",
        plant="mujoco",
        mode=mode.value,
        duration=trajectory_named(trajectory).duration if duration is None else positive("--duration", duration),
        fast=fast,
        trajectory=trajectory,
        human=human,
        seed=seed,
        table=shows_table(headless, viewer),
        window=viewer,
        force=False,
        real_time=rt,
        tasks=chosen,
        record=None if record is None else Path(record),
        notes={"task": "; ".join(task.about for task in chosen)},
    )
    run = run_cell(load_config(DEMO_CONFIG), options, stderr_console())
    print_summary(run, json)
    if not all(task.succeeded for task in run.tasks):
        raise typer.Exit(1)
