"""Tables of ``q2r2 ros watch``: arms, nodes and topics of a running set."""

from __future__ import annotations

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from q2r2_control.ros.watching.set_view import SILENT, NodeView, SetView, TopicView

_COLOURS = {"ok": "green", "warn": "yellow", "error": "red"}


def set_tables(view: SetView, domain: str) -> Group:
    """Why each arm moves or does not, what each node says, and what goes over each topic."""
    arms = _arm_table(view, domain)
    return Group(arms, _node_table(view), _topic_table(view)) if view.nodes else Group(arms)


def arm_lines(view: SetView) -> list[str]:
    """The same of the arms alone, in a line each."""
    return [f"{arm.name}: {arm.state or 'no node'}: {arm.why}" for arm in view.arms]


def _arm_table(view: SetView, domain: str) -> Table:
    table = _table(f"ROS domain {domain}: {len(view.nodes)} nodes of a set", "arm", "state", "controller", "why")
    for arm in view.arms:
        colour = "green" if arm.state == "engaged" else "default"
        state = Text(arm.state or "no node", style=colour if arm.node else "red")
        table.add_row(Text(arm.name), state, Text(arm.controller or "-"), Text(arm.why))
    return table


def _node_table(view: SetView) -> Table:
    table = _table("nodes", "node", "rate [Hz]", "age [s]", "level", "says")
    for node in view.nodes:
        silent = node.age > SILENT
        level = Text("silent", style="red") if silent else Text(node.level, style=_COLOURS.get(node.level, "default"))
        table.add_row(Text(node.name.removeprefix("/")), _rate(node), f"{node.age:.1f}", level, Text(node.message))
    if view.others:
        table.caption = Text(f"others in this domain: {', '.join(view.others)}")
        table.caption_justify = "left"
    return table


def _topic_table(view: SetView) -> Table:
    table = _table("topics", "topic", "rate [Hz]", "age [s]", "from", "to")
    for topic in view.topics:
        table.add_row(
            Text(topic.name), *_figures(topic), Text(_joined(topic.publishers)), Text(_joined(topic.subscribers))
        )
    table.caption = Text("rates without an age are what the sender says: commands and hands are not listened to")
    table.caption_justify = "left"
    return table


def _rate(node: NodeView) -> str:
    rate = node.values.get("loop_rate_hz")
    return f"{rate:.0f}" if isinstance(rate, int | float) else ""


def _figures(topic: TopicView) -> tuple[str, str]:
    rate = "" if topic.rate is None else f"{topic.rate:.0f}"
    return rate, "" if topic.age is None else f"{topic.age:.2f}"


def _joined(names: tuple[str, ...]) -> str:
    return ", ".join(name.removeprefix("/") for name in names) or "nobody"


def _table(title: str, *columns: str) -> Table:
    table = Table(title=Text(title), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for column in columns:
        figure = column.endswith("]")
        heading = Text(column.replace(" ", "\n", 1) if figure else column)
        table.add_column(heading, justify="right" if figure else "left", overflow="fold", no_wrap=figure)
    return table
