"""The input from a web page in a headset's browser. It runs in the process of the control loop."""

from __future__ import annotations

import io
import logging
import math
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from threading import Event
from typing import Any

from q2r2_control.config.cell import Config, HeadsetConfig
from q2r2_control.config.strict import Network
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.errors import ConfigError, InputError
from q2r2_control.extras import install_line
from q2r2_control.inputs.addresses import reachable_addresses
from q2r2_control.inputs.connections import SILENCE_ALLOWED
from q2r2_control.inputs.hand_stream import HandStream
from q2r2_control.inputs.headset import watch_of
from q2r2_control.inputs.listener import is_loopback
from q2r2_control.inputs.samples import HandsWatch
from q2r2_control.inputs.session import HeadsetStatistics
from q2r2_control.inputs.webxr import usb
from q2r2_control.inputs.webxr.certificate import installation_folder, installation_token, own_certificate
from q2r2_control.inputs.webxr.exchange import (
    Admitted,
    CameraPicture,
    Display,
    HeadsetPageSetup,
    Listening,
    Logged,
    Lost,
    Received,
    Requested,
    Shown,
)
from q2r2_control.inputs.webxr.page_messages import CONTROLS, HeadsetRequest
from q2r2_control.process.helper_process import HelperProcess, reason_of
from q2r2_control.types import SIDES, HandSample, HapticFeedback

PORT = 8443
_READY = 120.0  # Longest time until the process is ready, on a busy computer [s].
_PATIENCE, _LONGEST = 2.0, 10.0  # Longest time until the process ends if it is idle, and if it is busy [s].
_QUEUED = 2  # Number of states and pictures that may wait for the process. More would only delay the newest data.
_LOG = logging.getLogger(__name__)


_PACKAGES = ("websockets", "trimesh")  # Packages of the page. The extra `web` names them.


def _check_packages() -> None:
    """Raise :class:`InputError` if packages of the page are not installed. The error names them all."""
    if missing := [package for package in _PACKAGES if find_spec(package) is None]:
        raise InputError(f"--input webxr needs {' and '.join(missing)}: {install_line('web')}")


class WebXrInput:
    """Gives the hands of a headset's browser. Implements :class:`~q2r2_control.inputs.base.Input`.

    A process of its own serves the page and its socket, so that neither HTTPS nor JSON delays the loop. The messages of
    this process become samples in the same manner as the messages of the Quest2ROS app; see
    :class:`~q2r2_control.inputs.hand_stream.HandStream`. ``clock`` gives the time at which such a message comes [s].
    """

    controls = CONTROLS
    options = ("host", "port", "usb", "certificate", "say")

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = PORT,
        clock: Callable[[], float] = time.monotonic,
        allow: tuple[Network, ...] | None = None,
        watch: HandsWatch | None = None,
        by_usb: bool = False,
        certificate: Path | None = None,
        say: Callable[[str], None] = _LOG.info,
        silence: float = SILENCE_ALLOWED,
    ) -> None:
        """Make an input, which listens on ``host`` and ``port`` after :meth:`start`.

        A page that sends nothing for ``silence`` [s] is dropped. Long before that, the teleop layer stops the arms.
        """
        self.address = host, port  # After ``start``, the port is the bound port.
        self.urls: tuple[str, ...] = ()  # After ``start``, one URL for each address of this computer.
        self._clock, self._allow, self._usb, self._certificate, self._say = clock, allow, by_usb, certificate, say
        self._silence = silence
        self._stream = HandStream(watch or HandsWatch())
        self._display: Display | None = None
        self._requests: Mapping[HeadsetRequest, Callable[[], None]] = {}
        self._process: HelperProcess | None = None
        self._ready = Event()

    @classmethod
    def from_config(
        cls,
        config: Config,
        host: str | None = None,
        port: int | None = None,
        usb: bool = False,
        certificate: Path | None = None,
        say: Callable[[str], None] = _LOG.info,
    ) -> WebXrInput:
        """Make an input at the host of the cell's headset, or at another ``host``.

        Raises:
            ConfigError: If the host is not allowed.
            InputError: If a package of the page is not installed.
        """
        _check_packages()  # This check comes before slow work, such as measuring the loop's rate.
        headset = HeadsetConfig(**(config.headset.model_dump() | ({} if host is None else {"host": host})))
        if usb and not is_loopback(headset.host):
            raise ConfigError(f"--usb with --host {headset.host}: allowed: 127.0.0.1, which the cable leads to")
        port, allow = PORT if port is None else port, headset.networks
        return cls(
            headset.host, port, allow=allow, watch=watch_of(config), by_usb=usb, certificate=certificate, say=say
        )

    @staticmethod
    def cell(config: Config) -> Config:
        """Return the cell with the axes of the page's poses: x forward, y left, z up."""
        teleop = config.teleop.model_copy(update={"axes": TeleopSettings().axes})
        return config.model_copy(update={"teleop": teleop})

    def show_on(self, display: Display, requests: Mapping[HeadsetRequest, Callable[[], None]]) -> None:
        """Let pages show a run, and let their buttons have an effect. This is called before :meth:`start`.

        Args:
            display: Makes the data that the pages show.
            requests: The function to call for each request of a button.
        """
        self._display, self._requests = display, requests

    def show(self, content: Any) -> bool:
        """Show the newest state of the run. Return False if the last state is not sent yet. The method never waits."""
        return self._process is not None and self._process.send(Shown(content), 1)

    def show_picture(self, jpeg: bytes) -> bool:
        """Show the newest picture of a camera, in the manner of :meth:`show`. Any thread may call this method."""
        return self._process is not None and self._process.send(CameraPicture(jpeg), 1)

    def start(self) -> None:
        """Serve the page; raises :class:`InputError` or :class:`ConfigError` if that is not possible."""
        if self._process is not None:
            raise InputError(f"webxr: already serving {self.url}")
        _check_packages()
        host, port = self.address
        certificate, token, addresses = None, "", reachable_addresses(host)
        if not is_loopback(host):  # A browser trusts localhost without a certificate.
            folder = installation_folder()
            token, certificate = installation_token(folder), self._certificate
            if certificate is None:
                certificate, line = own_certificate(folder, addresses, datetime.now(UTC))
                if line is not None:
                    self._say(f"webxr: {line}")
        pem = None if certificate is None else str(certificate)
        setup = HeadsetPageSetup(host, port, self._allow, addresses, pem, token, self._silence, self._display)
        try:
            self._process = HelperProcess("serves the page", "q2r2_control.inputs.webxr.server", self._take, _QUEUED)
        except OSError as error:
            raise InputError(f"webxr: {reason_of(error)}") from error
        self._process.send(setup)
        waited = 0.0
        while self._process.alive and waited < _READY and not self._ready.wait(0.1):
            waited += 0.1
        if not self.urls:
            fault = self._process.fault or f"webxr: the page was not ready within {_READY:g} s"
            self.close()
            raise InputError(fault)
        if self._usb:
            try:
                usb.reverse(self.address[1])
            except InputError:
                self.close()
                raise
        self._announce()

    @property
    def connected(self) -> bool:
        """Whether a page is connected and sends hand data.

        After a lost connection it stays False until :meth:`poll` has noticed the loss.
        """
        return self._stream.connected and self._process is not None and self._process.alive

    @property
    def url(self) -> str | None:
        """The page's first URL; None before :meth:`start`."""
        return self.urls[0] if self.urls else None

    @property
    def driver(self) -> str | None:
        """The address of the page that drives, as host:port; None if no page drives."""
        return self._stream.peer

    def poll(self, now: float) -> list[HandSample]:
        return self._stream.take()

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Let a hand vibrate. The values are clipped to 0..1.

        Nothing happens if no page drives, or if a value is not finite.
        """
        values = (feedback.frequency, feedback.amplitude)
        if self._process is None or feedback.hand not in SIDES or not all(map(math.isfinite, values)):
            return
        frequency, amplitude = (min(max(float(value), 0.0), 1.0) for value in values)
        self._process.send(HapticFeedback(feedback.hand, frequency, amplitude))

    @property
    def statistics(self) -> HeadsetStatistics:
        """A snapshot for people."""
        return self._stream.statistics(self.address, self._clock())

    def close(self) -> None:
        """End the process. The method may be called twice."""
        process, self._process = self._process, None
        if process is None:
            return
        if self._usb and self.urls:
            try:
                usb.reverse(self.address[1], remove=True)
            except InputError as error:
                _LOG.debug("%s", error)
        process.finish(_PATIENCE, _LONGEST)
        self._stream.lose("server closed")
        self.urls = ()
        self._ready.clear()

    def _take(self, answer: Any) -> None:
        """Handle data from the process. A separate thread calls this method."""
        match answer:
            case Received(receptions):
                now = self._clock()
                for reception in receptions:
                    self._stream.receive(reception, now)
            case Admitted(peer):
                self._stream.admit(peer)
            case Lost(reason):
                self._stream.lose(reason)
            case Requested(request):
                if request in self._requests:
                    self._requests[request]()
            case Logged(level, text):
                _LOG.log(level, "%s", text)
            case Listening(port, urls):
                self.address, self.urls = (self.address[0], port), urls
                self._ready.set()

    def _announce(self) -> None:
        """Tell people the URLs of the page, as text and as QR codes for a camera."""
        host, port = self.address
        if self._usb:
            self._say(f"webxr: open http://localhost:{port} on the headset")
        for url in () if self._usb else self.urls:
            self._say(f"webxr: open {url}")
        if is_loopback(host):
            if not self._usb:
                self._say("webxr: only this machine can reach it; --host 0.0.0.0 admits the network, --usb a cable")
            return
        who = "" if self._allow is None else f" from {', '.join(map(str, self._allow))} (headset.allow)"
        what = "this URL" if len(self.urls) == 1 else "one of these URLs"
        self._say(f"webxr: whoever has {what}{who} can drive the arms")
        if find_spec("segno") is not None:
            for url in self.urls:
                self._say(_drawn(url) if len(self.urls) == 1 else f"{url}\n{_drawn(url)}")


def _drawn(url: str) -> str:
    """Return a QR code of ``url`` as text."""
    import segno

    drawn = io.StringIO()
    segno.make(url).terminal(drawn, compact=True)
    return drawn.getvalue().rstrip("\n")
