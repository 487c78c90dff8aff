"""The headset's server as the commands offer it: its address as options, and announced when it is bound."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.console import Console

from q2r2_control.config.cell import Config, HeadsetConfig
from q2r2_control.inputs.headset import HeadsetServer

Host = Annotated[str | None, typer.Option(help="Address to bind, instead of the config's; 0.0.0.0: every network.")]
Port = Annotated[int | None, typer.Option(min=0, max=65535, help="Port, instead of the config's; 0: any free one.")]


class AnnouncedHeadset(HeadsetServer):
    """A headset server that says where it listens, for people and for scripts that asked for port 0."""

    def __init__(self, config: Config, console: Console) -> None:
        super().__init__(config.headset.host, config.headset.port)
        self._console = console

    def start(self) -> None:
        """See :meth:`HeadsetServer.start`."""
        super().start()
        self._console.print(f"headset: listening on {self.address[0]}:{self.address[1]}", highlight=False)


def with_address(config: Config, host: str | None, port: int | None) -> Config:
    """The config with another address for the headset to connect to."""
    address = HeadsetConfig(
        host=config.headset.host if host is None else host, port=config.headset.port if port is None else port
    )
    return config.model_copy(update={"headset": address})
