"""``q2r2 ros``: what concerns ROS 2."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from q2r2_control.ros.build import BuildError, build_interfaces

app = typer.Typer(rich_markup_mode=None, help="ROS 2 Jazzy, from apt or from the Python registry.")


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
