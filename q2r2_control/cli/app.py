"""The ``q2r2`` command: its subcommands, and what all of them share."""

from __future__ import annotations

import atexit
import logging
import queue
import sys
from contextlib import suppress
from logging.handlers import QueueHandler, QueueListener
from typing import Any

import typer
from typer.core import TyperGroup

from q2r2_control.cli.bench import bench, soak
from q2r2_control.cli.check import check
from q2r2_control.cli.commission import commission
from q2r2_control.cli.doctor import doctor
from q2r2_control.cli.fri import fri_cabinet
from q2r2_control.cli.fri_check import fri_check
from q2r2_control.cli.mounts import mounts
from q2r2_control.cli.new_cell import new_cell
from q2r2_control.cli.recordings import export, judge, replay, report
from q2r2_control.cli.ros import app as ros_app
from q2r2_control.cli.run import demo, headset_check, run
from q2r2_control.errors import Q2R2Error

# typer raises its own copy of click's exceptions, or click's, depending on its version; this is the root of either.
_BadUsage: type[Exception] = typer.BadParameter.__mro__[2]


class ErrorHandlingGroup(TyperGroup):
    """Commands whose bad usage and :class:`Q2R2Error` end in one line on stderr and exit code 2, Ctrl-C in 130."""

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run the command line; leaves by :class:`SystemExit`."""
        extra["standalone_mode"] = False
        try:
            code = super().main(*args, **extra)
            sys.exit(code if isinstance(code, int) else 0)
        except (KeyboardInterrupt, typer.Abort):
            sys.exit(130)
        except Q2R2Error as error:
            message = str(error)
        except _BadUsage as error:
            context = getattr(error, "ctx", None)
            command = context.command_path if context else "q2r2"
            message = error.format_message()  # type: ignore[attr-defined]
            message = f"{message.rstrip('.')}; see {command} --help"
        print(f"q2r2: {' '.join(message.split())}", file=sys.stderr)
        sys.exit(2)


app = typer.Typer(
    cls=ErrorHandlingGroup,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Bimanual VR teleoperation: a headset's hands move two robot arms, safely.",
)
app.command(epilog="Example: q2r2 demo --viewer")(demo)
app.command(epilog="Example: q2r2 run config/dual_iiwa7.yaml --input headset --host 0.0.0.0")(run)
app.command(epilog="Example: q2r2 replay recordings/20260101-120000-dual_iiwa7 --compare")(replay)
app.command(epilog="Example: q2r2 judge recordings --json")(judge)
app.command(epilog="Example: q2r2 report recordings --output report.html")(report)
app.command("new-cell", epilog="Example: q2r2 new-cell my_cell --left arm.urdf --right arm.urdf")(new_cell)
app.command(epilog="Example: q2r2 check config/dual_iiwa7.yaml --pairs dual_iiwa7.srdf")(check)
app.command(epilog="Example: q2r2 doctor my_cell.yaml")(doctor)
app.command(epilog="Example: q2r2 commission my_cell.yaml --duration 60")(commission)
app.command("fri-cabinet", epilog="Example: q2r2 fri-cabinet config/dual_iiwa7_fri.yaml --period 2")(fri_cabinet)
app.command("fri-check", epilog="Example: q2r2 fri-check config/dual_iiwa7_fri.yaml --duration 60")(fri_check)
app.command("mounts", epilog="Example: q2r2 mounts my_cell.yaml --tip 0 0 0.1")(mounts)
app.command("headset-check", epilog="Example: q2r2 headset-check --host 0.0.0.0")(headset_check)
app.command(epilog="Example: q2r2 bench --ticks 20000, or --work --motion meet")(bench)
app.command(epilog="Example: q2r2 soak --ticks 100000 --contact")(soak)
app.command(epilog="Example: q2r2 export lerobot recordings --output datasets/circle --fps 30")(export)
app.add_typer(ros_app, name="ros")


class _StderrHandler(logging.Handler):
    """Writes to the stderr of that moment, so that lines appear above a live table and not across it."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):  # the terminal is gone
            print(self.format(record), file=sys.stderr)


@app.callback()
def main() -> None:
    """Let a thread write what is logged: a control loop must not wait for a terminal."""
    logger = logging.getLogger("q2r2_control")
    if not logger.handlers:
        records: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
        listener = QueueListener(records, _StderrHandler())
        logger.addHandler(QueueHandler(records))
        logger.setLevel(logging.INFO)
        listener.start()
        atexit.register(listener.stop)
