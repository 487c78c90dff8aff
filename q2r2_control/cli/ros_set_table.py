"""Tables of ``q2r2 ros watch``: arms, nodes and topics of a running set."""

from __future__ import annotations

from rich.console import Group
from rich.text import Text

from q2r2_control.cli.figure_table import Cell, figure_table
from q2r2_control.ros.watching.set_view import SILENT, ArmView, NodeView, SetView, TopicView

_COLOURS = {"ok": "green", "warn": "yellow", "error": "red"}
_NOTE = "rates are what the senders say"


def set_tables(view: SetView, domain: str) -> Group:
    """Why each arm moves or does not, what each node says, and what goes over each topic."""
    title = f"ROS domain {domain}: {len(view.nodes)} nodes of a set"
    arms = figure_table(title, ("arm", "state", "controller", "why"), map(_arm_cells, view.arms))
    if not view.nodes:
        return Group(arms)
    others = (f"others in this domain: {', '.join(view.others)}",) if view.others else ()
    columns = ("node", "rate [Hz]", "age [s]", "level", "says")
    nodes = figure_table("nodes", columns, map(_node_cells, view.nodes), others)
    topics = figure_table("topics", ("topic", "rate [Hz]", "from", "to"), map(_topic_cells, view.topics), (_NOTE,))
    return Group(arms, nodes, topics)


def arm_lines(view: SetView) -> list[str]:
    """The same of the arms alone, in a line each."""
    return [f"{arm.name}: {arm.state or 'no node'}: {arm.why}" for arm in view.arms]


def _arm_cells(arm: ArmView) -> tuple[Cell, ...]:
    colour = "green" if arm.state == "engaged" else "default"
    return arm.name, Text(arm.state or "no node", style=colour if arm.node else "red"), arm.controller or "-", arm.why


def _node_cells(node: NodeView) -> tuple[Cell, ...]:
    rate = node.values.get("loop_rate_hz")
    level = Text(node.level, style=_COLOURS.get(node.level, "default"))
    return (
        node.name.removeprefix("/"),
        f"{rate:.0f}" if isinstance(rate, int | float) else "",
        f"{node.age:.1f}",
        Text("silent", style="red") if node.age > SILENT else level,
        node.message,
    )


def _topic_cells(topic: TopicView) -> tuple[Cell, ...]:
    rate = "" if topic.rate is None else f"{topic.rate:.0f}"
    return topic.name, rate, _joined(topic.publishers), _joined(topic.subscribers)


def _joined(names: tuple[str, ...]) -> str:
    return ", ".join(name.removeprefix("/") for name in names) or "nobody"
