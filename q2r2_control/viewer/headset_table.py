"""The messages of a headset as a table: live or once."""

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

_REFRESH_RATE = 6.0  # [Hz]


def topic_table(title: str, topics: Mapping[str, TopicStatistics | None], silent: Collection[str] = ()) -> Table:
    """One row a topic, in the order given; None where nothing has come yet. Those in ``silent`` are marked."""
    table = Table(title=Text(title), title_justify="left", min_width=76)
    table.add_column("topic")
    for column in ("messages", "rate [Hz]", "age [s]"):
        table.add_column(Text(column), justify="right")
    table.add_column("last value")
    for name, topic in topics.items():
        figures, last = ("0", "", ""), "nothing yet"
        if topic is not None:
            figures, last = (str(topic.count), f"{topic.rate:.0f}", f"{topic.age:.2f}"), short_text(topic.last)
        late = name in silent
        table.add_row(name, *figures, Text(f"timeout  {last}" if late else last), style="red" if late else None)
    return table


def topic_line(name: str, topic: TopicStatistics | None, is_silent: bool) -> str:
    """One topic in one line."""
    prefix = f"{name}: timeout, " if is_silent else f"{name}: "
    if topic is None:
        return f"{prefix}nothing yet"
    return f"{prefix}{topic.count} messages, {topic.rate:.0f} Hz, {topic.age:.2f} s old: {short_text(topic.last)}"


def short_text(message: HandMessage) -> str:
    """A message's main values, rounded."""
    if isinstance(message, HandPose):
        return f"{_numbers(message.position)} m, quaternion {_numbers(message.quaternion)}"
    if isinstance(message, HandTwist):
        return f"{_numbers(message.linear)} m/s, {_numbers(message.angular)} rad/s"
    held = [name for name in ("upper", "lower") if getattr(message, f"button_{name}")]
    stick = f"{message.thumb_stick_horizontal:.1f} {message.thumb_stick_vertical:.1f}"
    triggers = f"{message.press_index:.1f} {message.press_middle:.1f}"
    return f"held: {' '.join(held) or 'none'}, triggers {triggers}, stick {stick}"


def _numbers(values: Iterable[float]) -> str:
    return " ".join(f"{round(value, 2) + 0.0:.2f}" for value in values)  # without minus zero


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


@contextmanager
def headset_display(console: Console) -> Iterator[Callable[[HeadsetCheck], None]]:
    """Show the state of a headset: as a live table on a terminal; elsewhere only advice, when it changes."""
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
