"""The commands of ``q2r2``, in the groups and the order of its help. Calling a command imports its module."""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

from typer import Typer
from typer.core import TyperCommand
from typer.main import get_command


class ListedCommand(NamedTuple):
    """A command as the help of ``q2r2`` lists it, and where its function is."""

    name: str
    at: str  # The command's module in this package, and the name of its function or Typer in that module.
    about: str  # First sentence of the function's docstring.
    group: str = ""  # Heading in the help.
    example: str = ""  # Example of a call, for a command without subcommands.


COMMANDS = (
    ListedCommand(
        "demo",
        "run:demo",
        "Let two simulated arms hand a bar to each other and stack blocks, driven only by samples of scripted hands.",
        "Move arms",
        "q2r2 demo --viewer",
    ),
    ListedCommand(
        "run",
        "run:run",
        "Run a cell until the duration is over or until Ctrl-C, and bring the arms to rest at the end.",
        "Move arms",
        "q2r2 run config/dual_iiwa7.yaml --input headset --host 0.0.0.0",
    ),
    ListedCommand(
        "replay",
        "recordings:replay",
        "Give a recorded run's hand samples and measured states to the same loop again, tick by tick.",
        "Move arms",
        "q2r2 replay recordings/20260101-120000-dual_iiwa7 --compare",
    ),
    ListedCommand(
        "new-cell",
        "new_cell:new_cell",
        "Write the YAML of a cell for models of your own: tips, grippers, mounts, a home, pairs of links, "
        "accelerations.",
        "Describe your cell",
        "q2r2 new-cell my_cell --left arm.urdf --right arm.urdf",
    ),
    ListedCommand(
        "check",
        "check:check",
        "Validate a cell and print its arms, limits, obstacles and distances at home.",
        "Describe your cell",
        "q2r2 check config/dual_iiwa7.yaml --pairs dual_iiwa7.srdf",
    ),
    ListedCommand(
        "mounts",
        "mounts:mounts",
        "Find where the right arm's base is: guide both tips by hand to the same points, one after the other.",
        "Describe your cell",
        "q2r2 mounts my_cell.yaml --tip 0 0 0.1",
    ),
    ListedCommand(
        "judge",
        "recordings:judge",
        "Say whether to keep or to discard each recorded episode, with reasons and numbers.",
        "Data to learn from",
        "q2r2 judge recordings --json",
    ),
    ListedCommand(
        "report",
        "recordings:report",
        "Write one HTML page of recorded episodes: verdicts, numbers and plots.",
        "Data to learn from",
        "q2r2 report recordings --output report.html",
    ),
    ListedCommand(
        "export",
        "recordings:export",
        "Make a training dataset from recordings of q2r2 run --record, with one episode for each recording.",
        "Data to learn from",
        "q2r2 export lerobot recordings --output dataset --fps 30 --ahead 1",
    ),
    ListedCommand(
        "evaluate",
        "evaluate:evaluate",
        "Let a policy try each task with many seeds in simulated time, and count successes.",
        "Data to learn from",
        "q2r2 evaluate examples.policy:Circles grasp stack --seeds 50",
    ),
    ListedCommand(
        "doctor",
        "doctor:doctor",
        "Say what this computer lacks to run a cell, and the cure of each fault.",
        "Devices",
        "q2r2 doctor my_cell.yaml",
    ),
    ListedCommand(
        "headset-check",
        "run:headset_check",
        "Show what a headset sends: connection, rates, ages, last values, and which way each hand moves.",
        "Devices",
        "q2r2 headset-check --host 0.0.0.0",
    ),
    ListedCommand(
        "cameras",
        "cameras:cameras",
        "List the cameras of this computer, and take a picture with each one of a cell; exit 1 where one gives none.",
        "Devices",
        "q2r2 cameras my_cell.yaml --output pictures",
    ),
    ListedCommand(
        "fri-check",
        "fri_check:fri_check",
        "Listen to the cabinets of a cell and say what they send.",
        "Devices",
        "q2r2 fri-check config/dual_iiwa7_fri.yaml --duration 60",
    ),
    ListedCommand(
        "fri-cabinet",
        "fri:fri_cabinet",
        "Simulate the Sunrise cabinets of a cell, whose arms q2r2 run --plant fri can drive.",
        "Devices",
        "q2r2 fri-cabinet config/dual_iiwa7_fri.yaml --period 2",
    ),
    ListedCommand(
        "commission",
        "commission:commission",
        "Commission the arms behind real cabinets step by step, with questions to you and with measurements.",
        "Devices",
        "q2r2 commission my_cell.yaml --duration 60",
    ),
    ListedCommand(
        "ros",
        "ros:app",
        "ROS 2 Jazzy, from apt or from the Python registry.",
        "Devices",
    ),
    ListedCommand(
        "bench",
        "bench:bench",
        "Time a tick of the controller with both arms, all pairs and the certificate, and compare public controllers.",
        "Measure",
        "q2r2 bench --work --motion meet",
    ),
    ListedCommand(
        "soak",
        "bench:soak",
        "Check every promise of a cell's controller under random hostile targets, ticks, starts and solver failures.",
        "Measure",
        "q2r2 soak --ticks 100000 --contact",
    ),
)


class CommandOnDemand(TyperCommand):
    """A command whose module is imported only when it is called. The help of ``q2r2`` does not need the module."""

    def __init__(self, command: ListedCommand) -> None:
        super().__init__(command.name, help=command.about)
        self._command = command

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Let the command itself parse ``args``. Return a context that calls the command."""
        return load(self._command).make_context(info_name, args, parent, **extra)


def load(command: ListedCommand) -> Any:
    """Import a command, and return it as a command object of click."""
    module, _, name = command.at.partition(":")
    found = getattr(import_module(f"{__package__}.{module}"), name)
    if not isinstance(found, Typer):
        function, found = found, Typer(add_completion=False, rich_markup_mode=None)
        found.command(command.name, epilog=f"Example: {command.example}")(function)
    return get_command(found)
