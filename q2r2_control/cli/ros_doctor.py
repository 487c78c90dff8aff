"""``q2r2 ros doctor``: what of ROS is missing, and what keeps the arms of a running set from moving."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer
from rich.console import Console
from rich.text import Text

from q2r2_control.cli.options import DEMO_CONFIG, Json, positive
from q2r2_control.cli.output import as_json_text
from q2r2_control.config.cell import load_config
from q2r2_control.process.signals import StopRequest, stop_on_signals
from q2r2_control.ros.launch.processes import nodes_of
from q2r2_control.ros.watching.environment import examine_environment
from q2r2_control.ros.watching.findings import Finding, examine_set

_TIME = 4.0  # in which a set is found, and a second publisher too [s]


def doctor(
    config: Annotated[
        str, typer.Argument(metavar="[CONFIG]", help="YAML of the cell that runs, or is to.")
    ] = DEMO_CONFIG,
    duration: Annotated[float, typer.Option(help="How long to listen to what runs [s].")] = _TIME,
    json: Json = False,
) -> None:
    """Say what of ROS is missing, which domain and middleware are used, which nodes run and what is wrong with them.

    Each finding stands with what helps. Like watch it takes part in nothing. Exit 1 when something was found that
    stops the arms; where no node of a set runs, only the environment is judged.
    """
    positive("--duration", duration)
    cell = load_config(config)
    expected = [node.name for node in nodes_of(config, "none", separate=True)]
    facts, findings = examine_environment(os.environ)
    nodes: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    if not any(finding.stops_arms for finding in findings):
        from q2r2_control.ros.watching.set_listener import watch_set

        stop = StopRequest()
        with stop_on_signals(stop.ask):
            view = watch_set(cell, duration, lambda view: None, lambda: stop.asked)
        nodes, others = tuple(node.name for node in view.nodes), view.others
        findings += examine_set(view, expected)
    stops = any(finding.stops_arms for finding in findings)
    if json:
        print(as_json_text({**facts, "nodes": nodes, "others": others, "findings": findings, "stops_arms": stops}))
    else:
        _print(
            facts | {"nodes": ", ".join(nodes) or "none of a set runs", "others": ", ".join(others) or "none"}, findings
        )
    sys.stdout.flush()
    raise typer.Exit(int(stops))


def _print(facts: dict[str, str], findings: list[Finding]) -> None:
    console = Console(highlight=False, soft_wrap=True)
    for name, value in facts.items():
        console.print(Text(f"{name:<11} {value}"))
    if not findings:
        console.print(Text("nothing is wrong", style="green"))
    for finding in sorted(findings, key=lambda finding: not finding.stops_arms):
        label, colour = ("stops arms", "red") if finding.stops_arms else ("warning", "yellow")
        console.print(Text(f"{label:<11} ", style=colour) + Text(finding.what, style="default"))
        console.print(Text(f"{'':<11} cure: {finding.cure}"))
