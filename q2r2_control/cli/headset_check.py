"""``q2r2 headset-check``: what a headset sends."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from q2r2_control.cli.headset_server import AnnouncedHeadset, Host, Port, with_address
from q2r2_control.cli.options import DEMO_CONFIG, Json, positive
from q2r2_control.cli.output import as_json_text, stderr_console
from q2r2_control.config.cell import load_config
from q2r2_control.inputs.headset_check import watch_headset
from q2r2_control.process.signals import StopRequest, stop_on_signals
from q2r2_control.viewer.headset_table import HeadsetDisplay, headset_table


def headset_check(
    config: Annotated[str, typer.Argument(metavar="[CONFIG]", help="Whose address and teleop.axes to use.")] = (
        DEMO_CONFIG
    ),
    host: Host = None,
    port: Port = None,
    duration: Annotated[float | None, typer.Option(help="[s]; without it, until Ctrl-C.")] = None,
    json: Json = False,
) -> None:
    """Show what a headset sends: connection, rates, ages, last values, and which way each hand moves.

    Move a hand forwards, to the left, up: where the words do not agree, change teleop.axes in the config.
    Exit 1 unless poses and inputs came of every hand that leads an arm; without both, run has nothing to engage.
    """
    cell = with_address(load_config(config), host, port)
    if duration is not None:
        positive("--duration", duration)
    console = stderr_console()
    server, stop = AnnouncedHeadset(cell, console), StopRequest()
    # From before the announcement on. KeyboardInterrupt would be lost where it comes in the middle of a finaliser.
    with stop_on_signals(stop.ask):
        server.start()
        try:
            with HeadsetDisplay(console) as display:
                check = watch_headset(server, cell, duration, display.show, lambda: stop.asked)
        finally:
            server.close()
    if json:
        print(as_json_text(check.as_json()))
    else:
        Console().print(headset_table(check))
    raise typer.Exit(1 if check.missing else 0)
