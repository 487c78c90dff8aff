"""Start and use the process that serves a page in a browser."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event as Flag
from types import MappingProxyType
from typing import Any, Self

from q2r2_control.config.cell import Config
from q2r2_control.device_words import QUEST_WORDS, DeviceWords
from q2r2_control.errors import ConfigError, InputError
from q2r2_control.extras import require
from q2r2_control.inputs.addresses import reachable_addresses
from q2r2_control.inputs.listener import is_loopback, listening_socket
from q2r2_control.inputs.webxr.certificate import installation_folder, own_certificate
from q2r2_control.process.helper_process import HelperProcess, reason_of
from q2r2_control.robot.robot import Robot
from q2r2_control.viewer.shown_robot import ShownRobot
from q2r2_control.viewer.web.exchange import Frame, PageRequest, PageSetting, PageSetup, PageWatched, Ready

_READY = 120.0  # Longest time until the process is ready, before the run, on a busy computer [s].
_PATIENCE, _LONGEST = 2.0, 10.0  # Longest time until the process ends if it is idle, and if it is busy [s].


class Page:
    """A page and the process that serves it. At the end of the context, the process ends.

    No browser can keep the caller's process waiting.
    """

    def __init__(self, host: str, port: int, on_answer: Callable[[Any], None], certificate: Path | None = None) -> None:
        """Start the process, which takes a second.

        Args:
            host: The address to listen on. Other computers get the page by HTTPS.
            port: The port to listen on; 0 for any free port.
            on_answer: Gets the requests of browsers, in a thread of its own.
            certificate: A PEM file for HTTPS; None for the certificate of the headset's page.

        Raises:
            ConfigError: If viser is not installed, or if the port is not free.
        """
        require("web", "--web")
        listening_socket(host, port, "--web").close()  # If the port is in use, this fails before slow work is done.
        self._host, self._port, self._on_request = host, port, on_answer
        self._ready = Flag()
        self.urls: tuple[str, ...] = ()  # One URL for each address of this computer; empty before :meth:`open`.
        self.lines: tuple[str, ...] = ()  # Lines for the user, with the URLs.
        self._certificate = certificate
        self.watched = False  # Whether any browser shows the page.
        self._pictures: dict[str, bytes] = {}  # For each camera, the picture that waits for the next frame.
        try:
            # Only one frame may wait, because a newer frame is better than a queue of old ones.
            self._process = HelperProcess("serves the page", "q2r2_control.viewer.web.server", self._on_answer, room=1)
        except OSError as error:
            raise ConfigError(f"--web: {reason_of(error)}") from error

    def open(
        self,
        robot: Robot,
        config: Config,
        title: str,
        requests: tuple[PageRequest, ...],
        changes: tuple[PageSetting, ...] = (),
        *,
        parts: Mapping[str, int] = MappingProxyType({}),
        device: DeviceWords = QUEST_WORDS,
        driven: bool = False,
        replayed: bool = False,
    ) -> str:
        """Serve the page of a cell, and return its first URL. The arguments are fields of :class:`PageSetup`.

        Raises:
            ConfigError: If the process fails, or is not ready in time.
        """
        addresses = reachable_addresses(self._host)
        certificate, notes = self._certified(addresses)
        setup = PageSetup(
            **vars(ShownRobot.of(robot, config)),
            host=self._host,
            port=self._port,
            addresses=addresses,
            certificate=certificate,
            title=title,
            tools={arm: its.frame_id for arm, its in robot.arms.items()},
            home=robot.home,
            lower=robot.position_lower,
            upper=robot.position_upper,
            model=robot.model,
            collision_model=robot.collision_model,
            parts=dict(parts),
            requests=requests,
            changes=changes,
            device=device,
            driven=driven,
            replayed=replayed,
        )
        self._process.send(setup)
        waited = 0.0
        while self._process.alive and waited < _READY and not self._ready.wait(0.1):
            waited += 0.1
        if not self.urls:
            raise ConfigError(self.fault or f"--web: the page was not ready within {_READY:g} s")
        self.lines = (*notes, *(f"page: {url}" for url in self.urls))
        return self.urls[0]

    def _certified(self, addresses: Sequence[str]) -> tuple[str | None, tuple[str, ...]]:
        """Return the PEM file for HTTPS, and lines about it for people. Without HTTPS, the file is None.

        A page that only this computer reaches needs no HTTPS.
        """
        if is_loopback(self._host):
            return None, ()
        if self._certificate is not None:
            return str(self._certificate), ()
        try:
            file, line = own_certificate(installation_folder(), addresses, datetime.now(UTC))
        except InputError as error:
            raise ConfigError(f"--web-host {self._host}: {error}") from error
        return str(file), () if line is None else (f"page: {line}",)

    @property
    def alive(self) -> bool:
        return self._process.alive

    @property
    def fault(self) -> str | None:
        """The reason why the process has ended too early; None if it has not."""
        return self._process.fault

    def send(self, frame: Frame) -> bool:
        """Show a frame. Return False, and show nothing, if the page is still busy with the previous frame."""
        pictures, self._pictures = self._pictures, {}
        sent = self._process.send(replace(frame, pictures=pictures) if pictures else frame, 1)
        if not sent:
            self._pictures = pictures | self._pictures
        return sent

    def show_picture(self, camera: str, picture: bytes) -> None:
        """Show a camera's ``picture`` (JPEG or PNG) with the next frame. Any thread may call this."""
        self._pictures = self._pictures | {camera: picture}

    def _on_answer(self, answer: Any) -> None:
        if isinstance(answer, Ready):
            self.urls = answer.urls
            self._ready.set()
        elif isinstance(answer, PageWatched):
            self.watched = answer.pages > 0
        else:
            self._on_request(answer)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.finish(_PATIENCE, _LONGEST)
