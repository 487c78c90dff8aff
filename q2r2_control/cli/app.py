"""The ``q2r2`` command, with everything that its subcommands share. The module ``commands`` lists the subcommands."""

from __future__ import annotations

import atexit
import logging
import queue
import sys
from contextlib import suppress
from itertools import groupby
from logging.handlers import QueueHandler, QueueListener
from operator import attrgetter
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from q2r2_control.cli.commands import COMMANDS, CommandOnDemand, installed_commands
from q2r2_control.errors import Q2R2Error

# Depending on its version, typer raises click's exceptions or its own copy of them. This is the base class of both.
_BadUsage: type[Exception] = typer.BadParameter.__mro__[2]

_PARTS = "q2r2_control."  # Names of our modules begin with this. An installation may lack some modules.
_INTERRUPTED = 130  # Exit code after Ctrl-C.


class ErrorHandlingGroup(TyperGroup):
    """The group of all subcommands, which turns their errors into lines on stderr and exit codes.

    Ctrl-C ends a command with exit code 130. Bad usage and a :class:`Q2R2Error` end it with 2. Each fault is one line.
    """

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for command in COMMANDS:
            self.add_command(CommandOnDemand(command))

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return the command of this name, from this or another package; None if there is none."""
        found = super().get_command(ctx, cmd_name)
        others = () if found is not None else installed_commands()  # Reading the entry points takes some time.
        return next((CommandOnDemand(other) for other in others if other.name == cmd_name), found)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands into the help, with each group under its heading."""
        for group, commands in groupby(COMMANDS, key=attrgetter("group")):
            with formatter.section(group):
                formatter.write_dl([(command.name, command.about) for command in commands])
        if others := installed_commands():
            with formatter.section("Other packages"):
                formatter.write_dl([(command.name, command.about) for command in others])

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run the command line. It always ends by raising :class:`SystemExit` with the exit code."""
        extra["standalone_mode"] = False
        messages: tuple[str, ...] = ("interrupted",)
        try:
            code = super().main(*args, **extra)
            if code != _INTERRUPTED:
                sys.exit(code if isinstance(code, int) else 0)
        except (KeyboardInterrupt, typer.Abort):
            code = _INTERRUPTED  # Newer versions of typer return this code instead of raising an error.
        except Q2R2Error as error:
            code, messages = 2, error.faults
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith(_PARTS):
                raise
            code, messages = 2, (f"this installation is without {error.name}, which the command needs",)
        except _BadUsage as error:
            context = getattr(error, "ctx", None)
            command = context.command_path if context else "q2r2"
            code, messages = 2, (f"{_usage_fault(error).rstrip('.')}; see {command} --help",)
        for message in messages:
            print(f"q2r2: {' '.join(message.split())}", file=sys.stderr)
        sys.exit(code)


def _usage_fault(error: Any) -> str:
    """Return a message about a wrong option or argument, in the same form as messages about a cell."""
    if not hasattr(error.__cause__, "errors"):  # Only pydantic's errors about values have this method.
        return str(error.format_message())
    # The import is here, because at the top of the file it would double the time of the help.
    from q2r2_control.config.strict import allowed_instead

    fault = error.__cause__.errors()[0]
    _, is_choice, choices = fault["msg"].partition(" is not one of ")
    allowed = f"allowed: {choices.replace(chr(39), '')}" if is_choice else allowed_instead(fault)
    name = error.param.opts[-1] if error.param.opts[-1].startswith("-") else error.param.human_readable_name
    return f"{name} = {fault['input']!r:.60}: {allowed}"


app = typer.Typer(
    cls=ErrorHandlingGroup,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Bimanual VR teleoperation: a headset's hands move two robot arms, safely.",
)


class _StderrHandler(logging.Handler):
    """Writes the log to the current ``sys.stderr``. Thus lines appear above a live table, and not within the table."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):  # Printing fails if the terminal was closed.
            print(self.format(record), file=sys.stderr)


def _print_version(asked: bool) -> None:
    if asked:
        # The import is here, because at the top of the file it would double the time of the help.
        from importlib.metadata import version

        print(f"q2r2 {version('q2r2_control')}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Let a thread write the log, because a control loop must not wait for a terminal."""
    logger = logging.getLogger("q2r2_control")
    if not logger.handlers:
        records: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
        listener = QueueListener(records, _StderrHandler())
        logger.addHandler(QueueHandler(records))
        logger.setLevel(logging.INFO)
        listener.start()
        atexit.register(listener.stop)
