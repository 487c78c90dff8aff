"""A table of figures under headings with units, as all benchmarks print theirs."""

from __future__ import annotations

from rich import box
from rich.table import Table
from rich.text import Text


def figure_table(title: str, names: str, figures: tuple[str, ...], padding: int = 1) -> Table:
    """A table whose first column holds ``names``; what follows a heading's first space stands in its second line.

    ``padding`` is what columns are apart, besides one space.
    """
    table = Table(
        title=Text(title), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, padding, 0, 0), pad_edge=False
    )
    table.add_column(names, no_wrap=True)
    for figure in figures:
        table.add_column(Text(figure.replace(" ", "\n", 1)), justify="right", no_wrap=True)
    return table
