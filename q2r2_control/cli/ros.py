"""``q2r2 ros``: what concerns ROS 2."""

from __future__ import annotations

import sys
from enum import StrEnum
from typing import Annotated

import typer

from q2r2_control.cli.options import Operator, Task, notes_of
from q2r2_control.cli.ros_doctor import doctor
from q2r2_control.cli.ros_watch import watch
from q2r2_control.ros.launch.build import BuildError, build_interfaces
from q2r2_control.ros.launch.processes import nodes_of, run_together

app = typer.Typer(rich_markup_mode=None, help="ROS 2 Jazzy, from apt or from the Python registry.")
app.command(epilog="Example: q2r2 ros watch config/dual_iiwa7.yaml --once")(watch)
app.command(epilog="Example: q2r2 ros doctor config/dual_iiwa7.yaml")(doctor)


class RobotSource(StrEnum):
    """The robot behind the nodes."""

    AUTO = "auto"
    MUJOCO = "mujoco"
    NONE = "none"


@app.command("build-interfaces", epilog="Example: q2r2 ros build-interfaces")
def build_interfaces_command(
    force: Annotated[bool, typer.Option("--force", help="Build again what this environment holds.")] = False,
) -> None:
    """Build the message packages that cannot be imported: quest2ros, and tf2_msgs and control_msgs where missing.

    They land in the running virtual environment; what a sourced ROS has is left alone. Exit 1 when a tool is missing.
    """
    try:
        build_interfaces(lambda line: print(line, flush=True), force)
    except BuildError as error:
        print(f"q2r2: {error}", file=sys.stderr)
        raise typer.Exit(1) from None


@app.command(epilog="Example: q2r2 ros up config/dual_iiwa7.yaml --input headset")
def up(
    config: Annotated[str, typer.Argument(metavar="CONFIG", help="YAML of the cell.")],
    input: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="An installed input, or none: another node sends the hands."),
    ] = None,
    robot: Annotated[
        RobotSource,
        typer.Option(help="Simulated, or one that is there; auto: mujoco for controller: builtin."),
    ] = RobotSource.AUTO,
    record: Annotated[
        str | None, typer.Option(metavar="DIR", help="Record what the nodes publish to a new folder in DIR.")
    ] = None,
    separate: Annotated[
        bool,
        typer.Option("--separate", help="A process for each arm: a hand then stops and homes its own arm only."),
    ] = False,
    task: Task = None,
    operator: Operator = None,
) -> None:
    """Start what a cell needs as ROS nodes, until Ctrl-C: robot, controller, the arms' teleop and an input.

    With controller: external the robot and its controllers are yours; what runs here are the arms' teleop and an input,
    and in mode filtered the built-in controller between both.
    A node that ends by itself is reported, and all others are stopped: exit 1.
    """
    notes = notes_of(task, operator, record)
    recording = None if record is None else {"folder": record, **notes}
    nodes = nodes_of(config, input, robot.value, recording, separate)
    raise typer.Exit(run_together(nodes, lambda line: print(line, flush=True)))
