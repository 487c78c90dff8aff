"""``q2r2 replay``: a recorded run once more, through the same loop."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from q2r2_control.cli.options import Json
from q2r2_control.cli.output import as_json_text, notice_of_compiling, stderr_console
from q2r2_control.cli.summary_table import summary_table
from q2r2_control.config import load_config
from q2r2_control.recording.replay import replay as replay_recording


def replay(
    file: Annotated[str, typer.Argument(metavar="FILE", help="The .mcap of q2r2 run --record, or its folder.")],
    compare: Annotated[
        bool, typer.Option("--compare", help="Say whether all was identical, else what first was not; exit 0 or 1.")
    ] = False,
    config: Annotated[
        str | None, typer.Option(metavar="CONFIG", help="Another cell's YAML than the recorded one.")
    ] = None,
    json: Json = False,
) -> None:
    """Give a recorded run's hand samples and measured states to the same loop again, tick by tick.

    With the same version and cell all commands are the same to the bit. Lines on stderr say what is not as it was.
    """
    console = stderr_console()
    with notice_of_compiling(console):
        result = replay_recording(Path(file), None if config is None else load_config(config))
    for note in result.notes:
        console.print(note, style="yellow", soft_wrap=True, highlight=False, markup=False)
    if result.ended_by is not None:
        console.print(f"ended after {result.ticks} ticks: {result.ended_by}", soft_wrap=True, highlight=False)
    verdict = "identical" if result.difference is None else f"first difference at {result.difference}"
    if json:
        data = {"ticks": result.ticks, "ended_by": result.ended_by, "notes": result.notes}
        summary = None if result.summary is None else result.summary.as_json()
        difference = {"difference": result.difference} if compare else {}
        print(as_json_text({**data, **difference, "summary": summary}))
    elif compare:
        print(verdict)
    elif result.summary is not None:
        Console().print(summary_table(result.summary))
    if compare and result.difference is not None:
        raise typer.Exit(1)
