"""The topics of a headset, as a table or line by line: counts, rates, ages, last values."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from rich.table import Table
from rich.text import Text

from q2r2_control.inputs.messages import HandMessage, HandPose, HandTwist
from q2r2_control.inputs.statistics import TopicStatistics


def topic_table(title: str, topics: Mapping[str, TopicStatistics | None], silent: Collection[str] = ()) -> Table:
    """One row a topic, in the order given; None where nothing has come yet. Those in ``silent`` are marked."""
    table = Table(title=Text(title), title_justify="left", min_width=76)
    table.add_column("topic")
    for column in ("messages", "rate [Hz]", "age [s]"):
        table.add_column(Text(column), justify="right")
    table.add_column("last value")
    for name, topic in topics.items():
        if topic is None:
            row = ("0", "", "", "nothing yet")
        else:
            row = (str(topic.count), f"{topic.rate:.0f}", f"{topic.age:.2f}", short_text(topic.last))
        table.add_row(name, *row[:3], Text(f"timeout  {row[3]}" if name in silent else row[3]))
        if name in silent:
            table.rows[-1].style = "red"
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
