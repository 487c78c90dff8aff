"""``q2r2 ros``: the commands for ROS 2."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text
from typer import Argument, Exit, Option
from typer.core import TyperCommand

from q2r2_control.cli.output import (
    DEMO_CONFIG,
    Anonymous,
    Json,
    Operator,
    Task,
    WebHost,
    WebPort,
    as_json_text,
    notes_of,
    positive,
    say,
)
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.extras import require
from q2r2_control.process.folders import check_folder
from q2r2_control.process.scheduling import StopRequest, stop_on_signals
from q2r2_control.ros.launch.build import BuildError, build_interfaces
from q2r2_control.ros.launch.processes import check_rclpy, in_ros, nodes_of, run_together
from q2r2_control.ros.watching.findings import Finding, examine_environment, examine_set
from q2r2_control.ros.watching.set_view import SILENT, ArmView, NodeView, SetView
from q2r2_control.viewer.tables import Cell, figure_table

_COLOURS = {"ok": "green", "warn": "yellow", "error": "red"}
_ROS_ARGUMENTS = "--ros-args"
_ONCE = 3.0  # In this time, a running set of nodes is found, and each node sends several messages [s].
_TIME = 4.0  # In this time, a running set of nodes and a second publisher of a topic are found [s].


def set_tables(view: SetView, domain: str) -> Group:
    """Return tables with the state of each arm and its reason, the message of each node, and the rate of each topic."""
    title = f"ROS domain {domain}: {len(view.nodes)} nodes of a set"
    arms = figure_table(title, ("arm", "state", "controller", "why"), map(_arm_cells, view.arms))
    if not view.nodes:
        return Group(arms)
    others = (f"others in this domain: {', '.join(view.others)}",) if view.others else ()
    columns = ("node", "rate [Hz]", "age [s]", "level", "says")
    nodes = figure_table("nodes", columns, map(_node_cells, view.nodes), others)
    rows = (
        (topic.name, _rounded(topic.rate), _joined(topic.publishers), _joined(topic.subscribers))
        for topic in view.topics
    )
    notes = ("rates are what the senders say",)
    return Group(arms, nodes, figure_table("topics", ("topic", "rate [Hz]", "from", "to"), rows, notes))


def _arm_cells(arm: ArmView) -> tuple[Cell, ...]:
    colour = "green" if arm.state == "engaged" else "default"
    return arm.name, Text(arm.state or "no node", style=colour if arm.node else "red"), arm.controller or "-", arm.why


def _node_cells(node: NodeView) -> tuple[Cell, ...]:
    level = Text(node.level, style=_COLOURS.get(node.level, "default"))
    return (
        node.name.removeprefix("/"),
        _rounded(node.values.get("loop_rate_hz")),
        f"{node.age:.1f}",
        Text("silent", style="red") if node.age > SILENT else level,
        node.message,
    )


def _rounded(rate: object) -> str:
    return f"{rate:.0f}" if isinstance(rate, int | float) else ""


def _joined(names: tuple[str, ...]) -> str:
    return ", ".join(name.removeprefix("/") for name in names) or "nobody"


def watch(
    config: Annotated[str, Argument(metavar="[CONFIG]", help="YAML of the cell.")] = DEMO_CONFIG,
    once: Annotated[bool, Option("--once", help="Print one table after --duration, then end.")] = False,
    duration: Annotated[
        float | None, Option(help=f"Duration [s]; by default {_ONCE:g} with --once or --json, else until Ctrl-C.")
    ] = None,
    json: Json = False,
) -> None:
    """Show nodes, topics, rates and ages of a running set, the state of each arm, and why it does not move.

    The command only listens, and ignores commands, so that it does not influence the set. If stderr is not a terminal,
    it prints a line whenever the state of an arm changes. Exit code 1 if no node of a set was heard.
    """
    cell = load_config(config)
    duration = positive("--duration", duration) or (_ONCE if once or json else None)
    check_rclpy()
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    view = _watched(cell, duration) if once or json else _watch_live(cell, domain, duration)
    if json:
        found = {"arms": view.arms, "nodes": view.nodes, "topics": view.topics, "others": view.others}
        print(as_json_text({"domain": domain, **found}))
    else:
        Console().print(set_tables(view, domain))
    raise Exit(0 if view.nodes else 1)


def _watched(
    cell: Config,
    duration: float | None,
    show: Callable[[SetView], None] = lambda view: None,
    drivers: bool = False,
) -> SetView:
    from q2r2_control.ros.watching.set_listener import watch_set

    stop = StopRequest()
    with stop_on_signals(stop.ask):
        return watch_set(cell, duration, show, lambda: stop.asked, drivers)


def _watch_live(cell: Config, domain: str, duration: float | None) -> SetView:
    console = Console(stderr=True)
    if not console.is_terminal:
        said: dict[str, str] = {}

        def tell(view: SetView) -> None:
            for arm in view.arms:
                line = f"{arm.name}: {arm.state or 'no node'}: {arm.why}"
                # Numbers are not compared, because ages change all the time.
                if said.get(arm.name) != (words := re.sub(r"[\d.]+", "", line)):
                    said[arm.name] = words
                    say(line, console)

        return _watched(cell, duration, tell)
    with Live(console=console, auto_refresh=False, transient=True) as live:
        return _watched(cell, duration, lambda view: live.update(set_tables(view, domain), refresh=True))


def doctor(
    config: Annotated[str, Argument(metavar="[CONFIG]", help="YAML of the cell.")] = DEMO_CONFIG,
    duration: Annotated[float, Option(help="Time to listen to the running nodes [s].")] = _TIME,
    json: Json = False,
) -> None:
    """Say which parts of ROS are missing, which domain and middleware are used, which nodes run, and their faults.

    The cure of each fault is printed. Like watch, the command only listens. Exit code 1 if a fault stops the arms. If
    no node of a set runs, only the environment is examined. With a preset lbr_*, the command also examines the KUKA
    drivers: their topics and sessions, and the limits of their robot_description, compared with those of the cell.
    """
    positive("--duration", duration)
    cell = load_config(config)
    expected = [node.name for node in nodes_of(config, "none", separate=True)]
    facts, findings = examine_environment(os.environ)
    nodes, others = list[str](), tuple[str, ...]()
    if not any(finding.stops_arms for finding in findings):
        from q2r2_control.ros.watching.lbr_drivers import examine_drivers

        view = _watched(cell, duration, drivers=True)
        nodes, others = [node.name for node in view.nodes], view.others
        findings += [*examine_set(view, expected), *examine_drivers(view, cell)]
    stops = any(finding.stops_arms for finding in findings)
    if json:
        print(as_json_text({**facts, "nodes": nodes, "others": others, "findings": findings, "stops_arms": stops}))
    else:
        running = {"nodes": ", ".join(nodes) or "none of a set runs", "others": ", ".join(others) or "none"}
        print_findings({**facts, **running}, findings)
    sys.stdout.flush()
    raise Exit(int(stops))


def print_findings(facts: dict[str, str], findings: list[Finding], worst: str = "stops arms") -> None:
    """Print facts and findings. Findings that stop arms come first, with the label ``worst``."""
    console = Console(highlight=False, soft_wrap=True)
    for name, value in facts.items():
        console.print(Text(f"{name:<11} {value}"))
    if not findings:
        console.print(Text("nothing is wrong", style="green"))
    for finding in sorted(findings, key=lambda finding: not finding.stops_arms):
        label, colour = (worst, "red") if finding.stops_arms else ("warning", "yellow")
        console.print(Text(f"{label:<11} ", style=colour) + Text(finding.what, style="default"))
        console.print(Text(f"{'':<11} cure: {finding.cure}"))


_ABOUT = "ROS 2 Jazzy, from apt or from the Python registry."
app = typer.Typer(add_completion=False, rich_markup_mode=None, help=_ABOUT)
app.command(epilog="Example: q2r2 ros watch config/dual_iiwa7.yaml --once")(watch)
app.command(epilog="Example: q2r2 ros doctor config/dual_iiwa7.yaml")(doctor)


class RobotSource(StrEnum):
    """Which robot ``q2r2 ros up`` starts.

    MUJOCO starts the simulation. NONE starts no robot, because the user's own robot already runs. AUTO starts the
    simulation if the cell needs it.
    """

    AUTO = "auto"
    MUJOCO = "mujoco"
    NONE = "none"


@app.command("build-interfaces", epilog="Example: q2r2 ros build-interfaces")
def build_interfaces_command(
    force: Annotated[bool, Option("--force", help="Build packages again that this environment has already.")] = False,
) -> None:
    """Build the message packages that cannot be imported: quest2ros, lbr_fri_idl, and tf2_msgs and control_msgs.

    The packages are installed into the running virtual environment. A sourced ROS is not changed. Exit code 1 if a tool
    is missing.
    """
    try:
        build_interfaces(lambda line: print(line, flush=True), force)
    except BuildError as error:
        print(f"q2r2: {error}", file=sys.stderr)
        raise Exit(1) from None


class _WithRosArguments(TyperCommand):
    """A command with arguments for ROS. They begin after ``--ros-args``, and end at ``--`` or at the line's end."""

    def parse_args(self, context: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        """Store the arguments for ROS in the context, and parse all other arguments."""
        first = args.index(_ROS_ARGUMENTS) if _ROS_ARGUMENTS in args else len(args)
        last = args.index("--", first) if "--" in args[first:] else len(args)
        context.meta[_ROS_ARGUMENTS] = args[first + 1 : last]
        return super().parse_args(context, args[:first] + args[last + 1 :])


@app.command(
    cls=_WithRosArguments,
    options_metavar="[OPTIONS] [--ros-args ...]",
    epilog="Example: q2r2 ros up config/dual_iiwa7.yaml --input headset --ros-args -r joint_trajectory:=/jtc/command",
)
def up(
    context: typer.Context,
    config: Annotated[str, Argument(metavar="CONFIG", help="YAML of the cell.")],
    input: Annotated[
        str | None, Option(metavar="NAME", help="An installed input, or none if another node is the input.")
    ] = None,
    robot: Annotated[
        RobotSource, Option(help="auto: mujoco if the cell has controller: builtin, else none.")
    ] = RobotSource.AUTO,
    record: Annotated[str | None, Option(metavar="DIR", help="Record all topics to a new folder in DIR.")] = None,
    separate: Annotated[
        bool, Option("--separate", help="Run each arm in its own process. Only its own hand stops it.")
    ] = False,
    web: Annotated[bool, Option("--web", help="Show the set in a browser; needs the extra `web`.")] = False,
    web_host: WebHost = "127.0.0.1",
    web_port: WebPort = 8080,
    task: Task = None,
    operator: Operator = None,
    anonymous: Anonymous = False,
    namespace: Annotated[str | None, Option(metavar="NAME", help="Namespace of all nodes, such as /cell.")] = None,
    sim_time: Annotated[
        bool, Option("--sim-time", help="Set use_sim_time, so that nodes take the time from /clock.")
    ] = False,
) -> None:
    """Start what a cell needs as ROS nodes, until Ctrl-C: robot, controller, the arms' teleop and an input.

    With controller: external, you start the robot and its controllers yourself. This command then starts the arms'
    teleop and an input, and in mode filtered also the built-in controller between them. If a node ends by itself, it is
    reported, and all others are stopped with exit code 1. Exit code 3 if the recording failed. Words after --ros-args
    are for all nodes: remappings, and parameters as NODE:NAME:=VALUE.
    """
    notes = notes_of(task, operator, record, anonymous)
    if record is not None:
        check_folder(Path(record), "--record")
    leaves_out: dict[str, str | float] = {"anonymous": True} if anonymous else {}
    recording = None if record is None else {"folder": record, **notes, **leaves_out}
    page = (web_host, web_port) if web else None
    if web:
        require("web", "--web")  # The check comes before any node starts.
    nodes = nodes_of(config, input, robot.value, recording, separate, page)
    nodes = in_ros(nodes, context.meta[_ROS_ARGUMENTS], namespace, sim_time)
    raise Exit(run_together(nodes, lambda line: print(line, flush=True)))
