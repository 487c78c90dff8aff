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
    """Makes a headset's display of a run; made by the run, used in the process of the page."""

    def scene(self) -> ShownScene:
        """Sent once to each page, as JSON."""

    def message(self, shown: Any) -> ShownState:
        """The JSON of what was given to :meth:`DisplayInput.show`."""


@dataclass(frozen=True)
class HeadsetPageSetup:
    """The first message to the process."""

    host: str
    port: int  # 0: any free one
    allow: Sequence[Network] | None  # that may connect; None: all
    addresses: Sequence[str]  # by which others reach it
    certificate: str | None  # a PEM file with its key; None: http
    token: str
    silence: float  # of the page that drives, after which it is dropped [s]
    display: Display | None


class Listening(NamedTuple):
    """The first answer: it listens."""

    port: int
    urls: tuple[str, ...]  # one for each of its addresses


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
