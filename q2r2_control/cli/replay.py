"""``q2r2 replay``: a recorded run once more, through the same loop, or its joint references alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from q2r2_control.cli.options import Json
from q2r2_control.cli.output import as_json_text, notice_of_compiling, stderr_console
from q2r2_control.cli.summary_table import summary_table
from q2r2_control.cli.window import check_window, show_window
from q2r2_control.config.cell import Config, load_config
from q2r2_control.errors import ConfigError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.joint_replay import replay_joints
from q2r2_control.recording.replay import replay as replay_recording

_LINES = 20  # of references that were held back

Prepare = Callable[[Pipeline], None]


def replay(
    file: Annotated[str, typer.Argument(metavar="FILE", help="The .mcap of q2r2 run --record, or its folder.")],
    compare: Annotated[
        bool, typer.Option("--compare", help="Say whether all was identical, else what first was not; exit 0 or 1.")
    ] = False,
    config: Annotated[
        str | None, typer.Option(metavar="CONFIG", help="Another cell's YAML than the recorded one.")
    ] = None,
    plant: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Let it move, and measure it; otherwise nothing moves."),
    ] = None,
    joints: Annotated[
        bool, typer.Option("--joints", help="Send the recorded joint references to the plant; exit 1 if any is held.")
    ] = False,
    viewer: Annotated[
        bool, typer.Option("--viewer", help="With --plant mujoco: open MuJoCo's window, at the speed of real time.")
    ] = False,
    json: Json = False,
) -> None:
    """Give a recorded run's hand samples and measured states to the same loop again, tick by tick.

    With the same version and cell all commands are the same to the bit. Lines on stderr say what is not as it was.
    With --plant the measured states are those of a plant that moves. With --joints no hands are replayed: the
    controller leads the plant to the first recorded reference and then along all of them, as far as its limits and
    distances allow.
    """
    if viewer:
        check_window(plant)
    cell = None if config is None else load_config(config)

    def prepare(pipeline: Pipeline) -> None:
        if viewer:
            show_window(pipeline, paced=True)

    if not joints:
        _replay(Path(file), cell, plant, compare, json, prepare)
    elif plant is None:
        raise ConfigError("--joints needs --plant, such as mujoco or kinematic, which follow the references")
    elif compare:
        raise ConfigError("--joints and --compare exclude each other: it says by itself what was not followed")
    else:
        _replay_joints(Path(file), cell, plant, json, prepare)


def _replay(file: Path, cell: Config | None, plant: str | None, compare: bool, json: bool, prepare: Prepare) -> None:
    with notice_of_compiling(stderr_console()):
        result = replay_recording(file, cell, plant, compare=compare, prepare=prepare)
    lines = [] if result.ended_by is None else [f"ended after {result.ticks} ticks: {result.ended_by}"]
    _say(result.notes, lines)
    verdict = "identical" if result.difference is None else f"first difference at {result.difference}"
    if json:
        data = {"ticks": result.ticks, "ended_by": result.ended_by, "notes": result.notes}
        summary = None if result.summary is None else result.summary.as_json()
        difference = {"difference": result.difference} if compare else {}
        found = {name: asdict(arm) for name, arm in result.arms.items()}
        arms = {} if plant is None else {"plant": plant, "arms": found}
        print(as_json_text({**data, **difference, **arms, "summary": summary}))
    elif compare:
        print(verdict)
    elif result.summary is not None:
        Console().print(summary_table(result.summary))
    if not json:
        for name, arm in result.arms.items():
            off = f"{arm.position_mm_rms:.3f} mm RMS, {arm.position_mm_max:.3f} mm and {arm.rotation_deg_max:.3f} deg"
            print(f"{name} arm: tool {off} at most from where it was when recorded")
    if compare and result.difference is not None:
        raise typer.Exit(1)


def _replay_joints(file: Path, cell: Config | None, plant: str, json: bool, prepare: Prepare) -> None:
    with notice_of_compiling(stderr_console()):
        result = replay_joints(file, plant, cell, prepare)
    lines = [held.line for held in result.held_back[:_LINES]]
    if more := len(result.held_back) - len(lines):
        lines.append(f"and {more} times more: --json has all")
    if result.ended_by is not None:
        lines.append(f"ended after {result.references} references: {result.ended_by}")
    _say(result.notes, lines)
    if json:
        summary = None if result.summary is None else result.summary.as_json()
        print(as_json_text({**asdict(result), "plant": plant, "summary": summary}))
    else:
        if result.summary is not None:
            Console().print(summary_table(result.summary))
        held = sum(held.references for held in result.held_back)
        near = f"the others were followed to {result.farthest_rad:.2g} rad"
        print(f"{result.references} references sent, {held} held back; {near}")
    if not result.whole:
        raise typer.Exit(1)


def _say(notes: Sequence[str], lines: Sequence[str]) -> None:
    """On stderr."""
    console = stderr_console()
    for note in notes:
        console.print(note, style="yellow", soft_wrap=True, highlight=False, markup=False)
    for line in lines:
        console.print(line, soft_wrap=True, highlight=False, markup=False)
