"""Output of commands: JSON on stdout, and all else on stderr or as tables."""

from __future__ import annotations

import json
import math
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields, is_dataclass
from typing import Annotated, Any

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from q2r2_control.errors import ConfigError

_NOTICE_AFTER = 3.0  # [s]


def as_json_text(value: Any) -> str:
    """``value`` as strict JSON: dataclasses and mappings as objects, arrays as lists, what is not finite as null."""
    return json.dumps(_jsonable(value), allow_nan=False)


def _jsonable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return _jsonable(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return _jsonable(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def stderr_console() -> Console:
    """For what is not a command's result."""
    return Console(stderr=True)


def print_report(data: Any, tables: Iterable[Table], json: bool) -> None:
    """Print a command's result on stdout: ``data`` as one JSON object, or the ``tables``."""
    if json:
        print(as_json_text(data))
        return
    console = Console()
    for table in tables:
        console.print(table)


def say(line: str, console: Console | None = None, style: str = "") -> None:
    """Print one line on stderr as it is, however long."""
    console = console or stderr_console()
    console.print(line, style=style, soft_wrap=True, highlight=False, markup=False)


@contextmanager
def counting(what: str = "") -> Iterator[Callable[[str, int, int], None]]:
    """Show how far a long work has got, where stderr is a terminal.

    The function that it yields takes what is counted (``what`` by default), how many are done, and how many there are.
    """
    console = stderr_console()
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(what, total=None)
        yield lambda of, done, total: progress.update(task, description=of or what, completed=done, total=total)


def print_progress(what: str) -> None:
    """Print a line on stderr, where that is a terminal; a live line would need a thread, which adds to times."""
    console = stderr_console()
    if console.is_terminal:
        console.print(what, highlight=False)


@contextmanager
def notice_of_compiling(console: Console) -> Iterator[None]:
    """Say what takes so long, where building the controller does."""
    text = "building the controller; where its code is new it is compiled for this machine first, 1-2 minutes"
    timer = threading.Timer(_NOTICE_AFTER, lambda: console.print(text, soft_wrap=True, highlight=False))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


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


Cell = Text | str | float | None


def figure_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[Cell]], notes: Sequence[str] = ()
) -> Table:
    """A table of figures and names under headings; ``notes`` are lines below it.

    A heading's unit, which follows its last space, stands in a second line. A column with a unit or with numbers keeps
    to the right and is never cut; others go on in the next line. A row of one cell is the heading of the rows below.
    """
    rows = [tuple(row) for row in rows]
    look: Any = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "pad_edge": False, "min_width": len(title)}
    table = Table(title=Text(title), title_justify="left", **look)
    for index, column in enumerate(columns):
        name, _, unit = column.rpartition(" ")
        numbers = any(isinstance(row[index], int | float) for row in rows if len(row) > index)
        figures = index > 0 and (numbers or unit.startswith(("[", "/")))
        heading = Text(f"{name}\n{unit}" if figures else column)
        table.add_column(heading, justify="right" if figures else "left", no_wrap=figures, overflow="fold")
    for row in rows:
        table.add_row(*map(_shown, row), style="bold" if len(row) == 1 < len(columns) else None)
    if notes:
        table.caption, table.caption_justify = Text("\n".join(notes)), "left"
    return table


def record_table(title: str, records: Sequence[Any], notes: Sequence[str] = ()) -> Table:
    """A row for each field of ``records``, dataclasses of one type, and a column for each of them.

    The first field names the columns. A field that holds several figures has one cell for all of them.
    """
    name, *others = (field.name for field in fields(records[0]))
    columns = (name, *(str(getattr(record, name)) for record in records))
    rows: list[list[Cell]] = [
        [field.replace("_", " "), *(_several(getattr(record, field)) for record in records)] for field in others
    ]
    return figure_table(title, columns, rows, notes)


def short_figure(value: float | None) -> str:
    """Three significant digits or so: two after the point below 10, one below 100, none above."""
    if value is None:
        return "-"
    digits = 2 if abs(value) < 9.995 else 1 if abs(value) < 99.95 else 0
    return f"{value:.{digits}f}"


def _shown(cell: Cell) -> Text:
    """Cells are never markup: a unit in brackets would be."""
    if isinstance(cell, Text):
        return cell
    return Text(str(cell) if isinstance(cell, str | int) else short_figure(cell))


def _several(value: Any) -> Text:
    values = value if isinstance(value, tuple | list) else (value,)
    return Text(" ".join(_shown(each).plain for each in values))
