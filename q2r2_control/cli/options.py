"""Options that several commands have, and their checks."""

from __future__ import annotations

import math
import sys
from typing import Annotated

import typer

from q2r2_control.errors import ConfigError

DEMO_CONFIG = "config/dual_iiwa7.yaml"

ConfigFile = Annotated[str, typer.Argument(metavar="CONFIG", help="The cell's YAML, such as config/dual_iiwa7.yaml.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout, and all else on stderr.")]
Headless = Annotated[bool, typer.Option("--headless", help="No live table, no window.")]
Viewer = Annotated[bool, typer.Option("--viewer", help="Open MuJoCo's window; closing it ends the run.")]
Human = Annotated[bool, typer.Option("--human", help="Scripted hands tremble, and samples get lost and late.")]
Seed = Annotated[int, typer.Option(min=0, help="Of what --human adds.")]
Record = Annotated[str | None, typer.Option(metavar="DIR", help="Record the run to a new folder in DIR.")]
RealTime = Annotated[
    bool,
    typer.Option("--rt", help="Lock memory and run under SCHED_FIFO; says what the system refuses, and runs anyway."),
]

Task = Annotated[str | None, typer.Option(help="With --record: what is done, noted in the recording.")]
Operator = Annotated[str | None, typer.Option(help="With --record: whose hands, noted as well.")]


def notes_of(task: str | None, operator: str | None, record: str | None) -> dict[str, str]:
    """Notes for a recording. Raises :class:`ConfigError` where there is none."""
    notes = {name: text for name, text in (("task", task), ("operator", operator)) if text is not None}
    for name in notes:
        if record is None:
            raise ConfigError(f"--{name} needs --record")
    return notes


def positive(option: str, value: float) -> float:
    """``value`` [s] of ``option``. Raises :class:`ConfigError` unless it is positive and finite."""
    if not (math.isfinite(value) and value > 0.0):
        raise ConfigError(f"{option} {value:g}: allowed: a positive number of seconds")
    return value


def shows_table(headless: bool, viewer: bool) -> bool:
    """Whether to show the live table. Raises :class:`ConfigError` where the options exclude each other."""
    if headless and viewer:
        raise ConfigError("--headless and --viewer exclude each other")
    return not headless and sys.stderr.isatty()
