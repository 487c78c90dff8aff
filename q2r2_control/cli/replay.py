"""``q2r2 replay``: a recorded run once more, through the same loop."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from q2r2_control.cli.cell_run import check_window, show_window
from q2r2_control.cli.output import Json, as_json_text, notice_of_compiling, stderr_console
from q2r2_control.cli.summary_table import summary_table
from q2r2_control.config.cell import load_config
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.replay import replay as replay_recording


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
    viewer: Annotated[
        bool, typer.Option("--viewer", help="With --plant mujoco: open MuJoCo's window, at the speed of real time.")
    ] = False,
    json: Json = False,
) -> None:
    """Give a recorded run's hand samples and measured states to the same loop again, tick by tick.

    With the same version and cell all commands are the same to the bit. Lines on stderr say what is not as it was.
    With --plant the measured states are those of a plant that moves.
    """
    if viewer:
        check_window(plant)
    cell = None if config is None else load_config(config)

    def prepare(pipeline: Pipeline) -> None:
        if viewer:
            show_window(pipeline, paced=True)

    with notice_of_compiling(stderr_console()):
        result = replay_recording(Path(file), cell, plant, compare=compare, prepare=prepare)
    console = stderr_console()
    for note in result.notes:
        console.print(note, style="yellow", soft_wrap=True, highlight=False, markup=False)
    if result.ended_by is not None:
        line = f"ended after {result.ticks} ticks: {result.ended_by}"
        console.print(line, soft_wrap=True, highlight=False, markup=False)
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
