"""``q2r2 headset-check``: what a headset sends."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from q2r2_control.cli.output import DEMO_CONFIG, Json, as_json_text, positive, stderr_console
from q2r2_control.config.cell import Config, HeadsetConfig, load_config
from q2r2_control.inputs.headset import HeadsetServer, watch_of
from q2r2_control.inputs.headset_check import watch_headset
from q2r2_control.inputs.listener import access_lines, written
from q2r2_control.process.scheduling import StopRequest, stop_on_signals
from q2r2_control.viewer.headset_table import HeadsetDisplay, headset_table

Host = Annotated[
    str | None, typer.Option(help="Address to bind, instead of the config's; 0.0.0.0: every network, :: IPv6 too.")
]
Port = Annotated[int | None, typer.Option(min=0, max=65535, help="Port, instead of the config's; 0: any free one.")]


class AnnouncedHeadset(HeadsetServer):
    """A headset server that says where it listens, for scripts that asked for port 0, and who can drive, for people."""

    def __init__(self, config: Config, console: Console) -> None:
        headset = config.headset
        super().__init__(headset.host, headset.port, allow=headset.networks, watch=watch_of(config))
        self._headset, self._console = headset, console

    def start(self) -> None:
        """See :meth:`HeadsetServer.start`."""
        super().start()
        for line in (f"listening on {written(*self.address)}", *access_lines(*self.address, self._headset.networks)):
            self._console.print(f"headset: {line}", soft_wrap=True, highlight=False, markup=False)


def with_address(config: Config, host: str | None, port: int | None) -> Config:
    """The config with another address for the headset to connect to."""
    given = {name: value for name, value in (("host", host), ("port", port)) if value is not None}
    return config.model_copy(update={"headset": HeadsetConfig(**(config.headset.model_dump() | given))})


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
