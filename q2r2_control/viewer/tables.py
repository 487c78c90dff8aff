"""The tables of all commands: figures and names under headings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any

from rich import box
from rich.table import Table
from rich.text import Text

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
