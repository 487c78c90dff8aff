"""A table of the messages of a headset. It is either live or printed once."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from q2r2_control.inputs.headset_check import HeadsetCheck
from q2r2_control.inputs.listener import written
from q2r2_control.inputs.messages import HandMessage, HandPose, HandTwist
from q2r2_control.inputs.session import TopicStatistics
from q2r2_control.viewer.tables import Cell, figure_table

_REFRESH_RATE = 6.0  # Greatest rate at which the live table is drawn [Hz].
_COLUMNS = ("topic", "messages", "rate [Hz]", "age [s]", "last value")


def topic_table(title: str, topics: Mapping[str, TopicStatistics | None], silent: Collection[str] = ()) -> Table:
    """Return a table with a row for each topic, in the given order. Topics in ``silent`` are marked.

    The statistics of a topic are None if no message has come yet.
    """
    return figure_table(title, _COLUMNS, _topic_rows(topics, silent))


def _topic_rows(topics: Mapping[str, TopicStatistics | None], silent: Collection[str] = ()) -> Iterator[list[Cell]]:
    for name, topic in topics.items():
        figures, last = ["0", "", ""], "nothing yet"
        if topic is not None:
            figures, last = [str(topic.count), f"{topic.rate:.0f}", f"{topic.age:.2f}"], short_text(topic.last)
        cells = [name, *figures, f"timeout  {last}" if name in silent else last]
        yield [Text(cell, style="red" if name in silent else "") for cell in cells]


def topic_line(name: str, topic: TopicStatistics | None, is_silent: bool) -> str:
    """Return one topic as one line of text."""
    prefix = f"{name}: timeout, " if is_silent else f"{name}: "
    if topic is None:
        return f"{prefix}nothing yet"
    return f"{prefix}{topic.count} messages, {topic.rate:.0f} Hz, {topic.age:.2f} s old: {short_text(topic.last)}"


def short_text(message: HandMessage) -> str:
    """Return the main values of a message, rounded."""
    if isinstance(message, HandPose):
        return f"{_numbers(message.position)} m, quaternion {_numbers(message.quaternion)}"
    if isinstance(message, HandTwist):
        return f"{_numbers(message.linear)} m/s, {_numbers(message.angular)} rad/s"
    held = [name for name in ("upper", "lower") if getattr(message, f"button_{name}")]
    stick = f"{message.thumb_stick_horizontal:.1f} {message.thumb_stick_vertical:.1f}"
    triggers = f"{message.press_index:.1f} {message.press_middle:.1f}"
    return f"held: {' '.join(held) or 'none'}, triggers {triggers}, stick {stick}"


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{round(value, 2) + 0.0:.2f}" for value in values)  # Adding 0.0 turns -0.0 into 0.0.


def headset_table(check: HeadsetCheck) -> Table:
    """Return a table of the connection, the topics, and the direction in which each hand moves."""
    statistics = check.statistics
    state = f"{statistics.peer} connected" if statistics.peer else "not connected"
    dialect = f", dialect {statistics.dialect}" if statistics.dialect else ""
    rows = list(_topic_rows(dict(sorted(statistics.topics.items()))))
    rows += [[name, count, "", "", "not read"] for name, count in statistics.unknown_topics.items()]
    for hand, direction in check.directions.items():
        position = check.positions[hand]
        where = "" if position is None else "at " + " ".join(f"{value:.2f}" for value in position)
        rows.append([f"{hand} hand moves", "", "", "", f"{direction}  {where}"])
    title = f"headset on {written(*statistics.address)}: {state}{dialect}"
    return figure_table(title, _COLUMNS, rows, check.advice)


@contextmanager
def headset_display(console: Console) -> Iterator[Callable[[HeadsetCheck], None]]:
    """Yield a function that shows the state of a headset, as a live table if the console is a terminal.

    Otherwise the function prints only the advice, each time that it changes.
    """
    drawn, advised = -math.inf, tuple[str, ...]()

    def advise(check: HeadsetCheck) -> None:
        nonlocal advised
        if check.advice != advised:
            for line in check.advice:
                console.print(line, soft_wrap=True, highlight=False, markup=False)
        advised = check.advice

    def draw(check: HeadsetCheck) -> None:
        nonlocal drawn
        if time.monotonic() - drawn >= 1.0 / _REFRESH_RATE:
            drawn = time.monotonic()
            live.update(headset_table(check), refresh=True)

    if not console.is_terminal:
        yield advise
        return
    with Live(console=console, auto_refresh=False, transient=True) as live:
        yield draw
