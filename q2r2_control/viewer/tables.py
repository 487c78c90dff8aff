"""Printed tables, which all commands use: numbers and names under headings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import fields
from textwrap import wrap
from typing import Any

from rich import box
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

Cell = Text | str | float | None
_NARROWEST_NAME = 12  # A column of names is folded, but not to fewer characters than this.
_UNIT = re.compile(r" (\[[^][]*\]|/\S*)$")
_WIDEST = 1000  # The width of a whole table is measured as on a console of this width [characters].


def figure_table(
    title: str, columns: Sequence[str], given: Iterable[Sequence[Cell]], notes: Sequence[str] = ()
) -> Table:
    """Return a table of figures and names under headings; ``notes`` are lines below it.

    The unit at the end of a heading is put into a second line. A column with a unit or with numbers is aligned to the
    right, and is never cut. In other columns, text that is too long continues in the next line. A row of one cell is
    the heading of the rows below. If the console is too narrow, the table is wider than the console. The table
    therefore has to be printed by :func:`print_table`.
    """
    given = list(given)
    rows = [tuple(map(_shown, row)) for row in given]
    look: Any = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "pad_edge": False, "min_width": len(title)}
    table = Table(title=Text(title), title_justify="left", **look)
    for index, column in enumerate(columns):
        name, unit = _split_heading(column)
        numbers = any(isinstance(row[index], int | float) for row in given if len(row) > index)
        figures = index > 0 and (numbers or bool(unit))
        cells = [row[index].plain for row in rows if len(row) > max(index, 1)]
        if figures:
            width = max(map(len, (*name.split(), unit, *cells)))
            heading = "\n".join([*wrap(name, width), unit])
        else:
            heading, width = column, min(max(map(len, (column, *cells))), _NARROWEST_NAME)
        look = {"justify": "right" if figures else "left", "no_wrap": figures, "overflow": "fold", "min_width": width}
        table.add_column(Text(heading), **look)
    for row in rows:
        table.add_row(*row, style="bold" if len(row) == 1 < len(columns) else None)
    if notes:
        table.caption, table.caption_justify = Text("\n".join(notes)), "left"
    return table


def print_table(table: Table, console: Console) -> None:
    """Print a table without cutting figures off. Its lines may be longer than the console is wide.

    On a terminal, the notes below the table are folded to the table's width. A file or another program gets each note
    in one line.
    """
    of_title, table.min_width = table.min_width, None
    widths = Measurement.get(console, console.options.update(max_width=_WIDEST), table)
    # A file or another program gets whole cells. On a terminal, a folded cell is easier to read than a wrapped line.
    needed = widths.minimum if console.is_terminal else widths.maximum
    table.min_width, table.width = of_title, needed if needed > console.width else None
    notes = table.caption
    if not console.is_terminal:
        table.caption = None
    console.print(table, soft_wrap=False, crop=False)
    if notes is not None and table.caption is None:
        console.print(notes, soft_wrap=True, highlight=False)


def _split_heading(column: str) -> tuple[str, str]:
    """Return the name and the unit of a heading such as "error [mm RMS]" or "force /N"; "" if it has no unit."""
    found = _UNIT.search(column)
    return (column, "") if found is None else (column[: found.start()], found[1])


def record_table(title: str, records: Sequence[Any], notes: Sequence[str] = ()) -> Table:
    """Return a table with a row for each field of ``records``, dataclasses of one type, and a column for each record.

    The values of the first field are the headings of the columns. If a field of a record has several numbers, they are
    all in one cell.
    """
    name, *others = (field.name for field in fields(records[0]))
    columns = (name, *(str(getattr(record, name)) for record in records))
    rows: list[list[Cell]] = [
        [field.replace("_", " "), *(_several(getattr(record, field)) for record in records)] for field in others
    ]
    return figure_table(title, columns, rows, notes)


def times_real_time(factor: float) -> str:
    """Return the speed of simulated time in words, with two digits if it is slow."""
    return f"{factor:.1f} x real time" if factor >= 0.995 else f"{factor:.2g} x real time"


def short_figure(value: float | None) -> str:
    """Return a number with about three digits: 2 decimals below 10, 1 decimal below 100, otherwise 0; "-" for None."""
    if value is None:
        return "-"
    digits = 2 if abs(value) < 9.995 else 1 if abs(value) < 99.95 else 0
    return f"{value:.{digits}f}"


def _shown(cell: Cell) -> Text:
    """Return a cell as Text, because Rich would read a unit in brackets as markup."""
    if isinstance(cell, Text):
        return cell
    return Text(str(cell) if isinstance(cell, str | int) else short_figure(cell))


def _several(value: Any) -> Text:
    values = value if isinstance(value, tuple | list) else (value,)
    return Text(" ".join(_shown(each).plain for each in values))
