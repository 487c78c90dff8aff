"""The data that a run's input and the process that serves its page send to each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from q2r2_control.config.strict import Network
from q2r2_control.inputs.session import Reception
from q2r2_control.inputs.webxr.page_messages import HeadsetRequest
from q2r2_control.inputs.webxr.shown import ShownScene, ShownState


class Display(Protocol):
    """Makes the data of a run that a headset shows. The run creates the instance, and the page's process uses it."""

    def scene(self) -> ShownScene:
        """Return the data that is sent once to each page, in a form that JSON can represent."""

    def message(self, shown: Any) -> ShownState:
        """Return the data of a state that was passed to :meth:`WebXrInput.show`, in a form that JSON can represent."""


@dataclass(frozen=True)
class HeadsetPageSetup:
    """The first message to the process that serves the page."""

    host: str
    port: int  # The port to listen on; 0 for any free port.
    allow: Sequence[Network] | None  # Networks that may connect; None for all.
    addresses: Sequence[str]  # Addresses at which other computers reach the page.
    certificate: str | None  # A PEM file with a certificate and its key; None for HTTP.
    token: str
    silence: float  # A page that drives is dropped if it sends nothing for this time [s].
    display: Display | None


class Listening(NamedTuple):
    """The first answer, which says that the process listens."""

    port: int
    urls: tuple[str, ...]  # One URL for each address of the server.


class Admitted(NamedTuple):
    """Says that the page with the address ``peer`` drives from now on."""

    peer: str


class Lost(NamedTuple):
    """Says that the connection to the page that drove has ended, and why."""

    reason: str


class Received(NamedTuple):
    """The newest poses and controls of the hands, from the page that drives."""

    receptions: list[Reception]


class Requested(NamedTuple):
    """The request of a button of a page."""

    request: HeadsetRequest


class Logged(NamedTuple):
    """A line for the log."""

    level: int
    text: str


class Shown(NamedTuple):
    """The newest state of the run, which the page shows."""

    content: Any


class CameraPicture(NamedTuple):
    """The newest picture of a camera."""

    jpeg: bytes
