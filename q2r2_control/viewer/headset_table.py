"""The messages of a headset as a table: live or once."""

from __future__ import annotations

import time

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from q2r2_control.inputs.addresses import written
from q2r2_control.inputs.headset_check import HeadsetCheck
from q2r2_control.viewer.topic_table import topic_table

_REFRESH_RATE = 6.0  # [Hz]


def headset_table(check: HeadsetCheck) -> Table:
    """Connection, topics, and where the hands move."""
    statistics = check.statistics
    state = f"{statistics.peer} connected" if statistics.peer else "not connected"
    dialect = f", dialect {statistics.dialect}" if statistics.dialect else ""
    table = topic_table(
        f"headset on {written(*statistics.address)}: {state}{dialect}", dict(sorted(statistics.topics.items()))
    )
    for name, count in statistics.unknown_topics.items():
        table.add_row(Text(name), str(count), "", "", "not read")
    table.add_section()
    for hand, direction in check.directions.items():
        position = check.positions[hand]
        where = "" if position is None else "at " + " ".join(f"{value:.2f}" for value in position)
        table.add_row(f"{hand} hand moves", "", "", "", f"{direction}  {where}")
    # Text without markup, since a reason may quote what the client sent.
    table.caption = Text("\n".join(check.advice)) if check.advice else None
    table.caption_justify = "left"
    return table


class HeadsetDisplay:
    """Shows the state of a headset: as a live table on a terminal; elsewhere only advice, when it changes."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._drawn = -np.inf
        self._advised: tuple[str, ...] = ()

    def __enter__(self) -> HeadsetDisplay:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, check: HeadsetCheck) -> None:
        """Show the newest state."""
        if self._live is None:
            if check.advice != self._advised:
                for line in check.advice:
                    self._console.print(line, soft_wrap=True, highlight=False, markup=False)
            self._advised = check.advice
        elif time.monotonic() - self._drawn >= 1.0 / _REFRESH_RATE:
            self._drawn = time.monotonic()
            self._live.update(headset_table(check), refresh=True)
