"""The data that the input of a run and the process of its page exchange."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from q2r2_control.config.strict import Network
from q2r2_control.inputs.session import Reception
from q2r2_control.inputs.webxr.page_messages import HeadsetRequest
from q2r2_control.inputs.webxr.shown import ShownScene, ShownState


class Display(Protocol):
    """Makes the data that a headset shows of a run. The run makes this object, and the page's process uses it."""

    def scene(self) -> ShownScene:
        """Return the data that is sent once to each page, as JSON."""

    def message(self, shown: Any) -> ShownState:
        """Return the JSON data of the state that was given to :meth:`DisplayInput.show`."""


@dataclass(frozen=True)
class HeadsetPageSetup:
    """The first message to the process."""

    host: str
    port: int  # The port to listen on; 0 for any free port.
    allow: Sequence[Network] | None  # Networks that may connect; None for all.
    addresses: Sequence[str]  # Addresses by which others reach the page.
    certificate: str | None  # A PEM file with its key; None for HTTP.
    token: str
    silence: float  # A page that drives is dropped if it sends nothing for this time [s].
    display: Display | None


class Listening(NamedTuple):
    """The first answer, which says that the process listens."""

    port: int
    urls: tuple[str, ...]  # One URL for each of its addresses.


class Admitted(NamedTuple):
    """A page drives from now on."""

    peer: str


class Lost(NamedTuple):
    """The page that drove is gone."""

    reason: str


class Received(NamedTuple):
    """The newest hands of the page that drives."""

    receptions: list[Reception]


class Requested(NamedTuple):
    """A button of a page was pressed."""

    request: HeadsetRequest


class Logged(NamedTuple):
    """A line for the log."""

    level: int
    text: str


class Shown(NamedTuple):
    """The newest state of the run, for the display."""

    content: Any


class CameraPicture(NamedTuple):
    """The newest picture of a camera."""

    jpeg: bytes
