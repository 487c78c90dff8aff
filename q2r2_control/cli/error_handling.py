"""Every error of the command line in one line, with exit code 2."""

from __future__ import annotations

import sys
from typing import Any

import typer
from typer.core import TyperGroup

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
        except Q2R2Error as error:
            _fail(str(error))
        except (KeyboardInterrupt, typer.Abort):
            sys.exit(130)
        except _BadUsage as error:
            context = getattr(error, "ctx", None)
            command = context.command_path if context else "q2r2"
            message = error.format_message()  # type: ignore[attr-defined]
            _fail(f"{message.rstrip('.')}; see {command} --help")
        sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str) -> None:
    print(f"q2r2: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(2)
