"""The headset's server as the commands offer it: its address as options, and announced when it is bound."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from q2r2_control.config.cell import Config, HeadsetConfig
from q2r2_control.inputs.addresses import access_lines, written
from q2r2_control.inputs.headset import HeadsetServer, watch_of

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
