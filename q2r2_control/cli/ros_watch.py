"""``q2r2 ros watch``: a running set of nodes, live or once."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from typing import Annotated

import typer
from rich.console import Console
from rich.live import Live

from q2r2_control.cli.options import DEMO_CONFIG, Json, positive
from q2r2_control.cli.output import as_json_text, stderr_console
from q2r2_control.cli.ros_set_table import arm_lines, set_tables
from q2r2_control.config.cell import Config, load_config
from q2r2_control.process.signals import StopRequest, stop_on_signals
from q2r2_control.ros.launch.processes import check_rclpy
from q2r2_control.ros.watching.set_view import SetView

_ONCE = 3.0  # in which a set is found, and its nodes have spoken several times [s]


def watch(
    config: Annotated[str, typer.Argument(metavar="[CONFIG]", help="YAML of the cell that runs.")] = DEMO_CONFIG,
    once: Annotated[bool, typer.Option("--once", help="Print one table after --duration, and end.")] = False,
    duration: Annotated[
        float | None, typer.Option(help=f"[s]; without it until Ctrl-C, with --once and --json {_ONCE:g} s.")
    ] = None,
    json: Json = False,
) -> None:
    """Show nodes, topics, rates and ages of a running set, the state of each arm, and why it does not move.

    It only listens, and to no command: a set runs as if nobody watched. Where stderr is no terminal it prints a line
    for an arm whenever that changes. Exit 1 when no node of a set was heard.
    """
    cell = load_config(config)
    if duration is not None:
        positive("--duration", duration)
    elif once or json:
        duration = _ONCE
    check_rclpy()
    from q2r2_control.ros.watching.set_listener import watch_set

    domain, stop = os.environ.get("ROS_DOMAIN_ID") or "0", StopRequest()
    with stop_on_signals(stop.ask):
        if once or json:
            view = watch_set(cell, duration, lambda view: None, lambda: stop.asked)
        else:
            view = _watch_live(cell, domain, duration, lambda: stop.asked)
    if json:
        print(
            as_json_text(
                {"domain": domain, "arms": view.arms, "nodes": view.nodes, "topics": view.topics, "others": view.others}
            )
        )
    else:
        Console().print(set_tables(view, domain))
    raise typer.Exit(0 if view.nodes else 1)


def _watch_live(cell: Config, domain: str, duration: float | None, stop: Callable[[], bool]) -> SetView:
    from q2r2_control.ros.watching.set_listener import watch_set

    console = stderr_console()
    if not console.is_terminal:
        said: dict[int, str] = {}

        def tell(view: SetView) -> None:
            for index, line in enumerate(arm_lines(view)):
                if said.get(index) != (words := re.sub(r"[\d.]+", "", line)):  # an age changes all the time
                    said[index] = words
                    console.print(line, soft_wrap=True, highlight=False, markup=False)

        return watch_set(cell, duration, tell, stop)
    with Live(console=console, auto_refresh=False, transient=True) as live:
        return watch_set(cell, duration, lambda view: live.update(set_tables(view, domain), refresh=True), stop)
