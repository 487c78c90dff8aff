"""The TCP server for the Quest2ROS app. It has one background thread, serves one headset at a time, and uses no ROS."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace

from q2r2_control.config.cell import Config, HeadsetConfig
from q2r2_control.config.strict import Network
from q2r2_control.errors import InputError
from q2r2_control.inputs.connections import TURN, Client, Connections, Handlers
from q2r2_control.inputs.hand_stream import HandStream
from q2r2_control.inputs.listener import HostLog, TcpListener, access_lines, why_not_bound, written
from q2r2_control.inputs.messages import WireFrame, warm_up
from q2r2_control.inputs.samples import HandsWatch, Watched
from q2r2_control.inputs.session import HeadsetStatistics
from q2r2_control.types import QUEST_CONTROLS, SIDES, HandSample, HapticFeedback

_LOG = logging.getLogger(__name__)


def watch_of(config: Config) -> HandsWatch:
    """Return an object that uses the settings of the cell to detect faults of a headset's poses."""
    headset = config.headset
    return HandsWatch(headset.frozen_time, headset.watch_frame, config.teleop.gate.timeout)


class HeadsetServer:
    """Receives hand samples from the Quest2ROS app, and sends it vibrations.

    Implements :class:`~q2r2_control.inputs.base.Input`. The loop's thread never waits for the network or for decoding.
    A client that breaks the protocol, sends too many frames, or is silent for 2 s is dropped with one logged line.

    Args:
        host: The address to listen on.
        port: The port to listen on; 0 for any free port.
        clock: The clock of the samples' stamps, which are the times at which their bytes are received [s].
        listener: Gets each message at once, in the receiving thread. If it is given, :meth:`poll` returns nothing.
        allow: The networks whose hosts may connect; None for all networks. If several clients connect,
            :func:`~q2r2_control.inputs.listener.decide` decides which one drives.
        watch: Finds poses that must not be followed.
        say: Gets lines for people when the server listens: its address, and who can drive.
    """

    controls = QUEST_CONTROLS
    options = ("host", "port", "say")
    executable = "tcp_endpoint"
    url: str | None = None  # None, because this server serves an app and no page.

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 10000,
        clock: Callable[[], float] = time.monotonic,
        listener: Callable[[Watched], None] | None = None,
        allow: Sequence[Network] | None = None,
        watch: HandsWatch | None = None,
        say: Callable[[str], None] = _LOG.debug,
    ) -> None:
        self.address = host, port  # After ``start``, the port is the bound port.
        self._allow, self._clock, self._say = allow, clock, say
        self._stream = HandStream(watch or HandsWatch(), listener)
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._owed: dict[str, HapticFeedback] = {}  # The newest vibration of each hand that has not been sent yet.
        self._owed_lock = threading.Lock()
        self._session_lock = threading.Lock()  # Neither poll nor send_haptic waits for this lock.
        self._client: Client | None = None  # The client that was admitted last. It may have disconnected.

    @classmethod
    def from_config(
        cls, config: Config, host: str | None = None, port: int | None = None, say: Callable[[str], None] = _LOG.debug
    ) -> HeadsetServer:
        """Make a server at the address of the cell's headset, or at another ``host`` or ``port``."""
        given = {name: value for name, value in (("host", host), ("port", port)) if value is not None}
        headset = HeadsetConfig(**(config.headset.model_dump() | given))
        return cls(headset.host, headset.port, allow=headset.networks, watch=watch_of(config), say=say)

    def start(self) -> None:
        """Listen for headsets.

        Raises:
            InputError: If host and port cannot be bound, or if the server was started already.
        """
        if self._thread is not None:
            raise InputError(f"headset: already listening on {written(*self.address)}")
        warm_up()
        host, port = self.address
        try:
            door = TcpListener(host, port, HostLog(_LOG))
        except (OSError, OverflowError, ValueError) as error:
            why = why_not_bound(error)
            raise InputError(f"headset: cannot listen on {written(host, port)}: {why}; allowed: a free port") from error
        self.address = (host, door.port)
        handlers = Handlers(admitted=self._admit, lost=self._stream.lose, receive=self._receive, due=self._take_owed)
        self._connections = Connections(door, self._allow, self._clock, handlers)
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, args=(self._connections,), name="headset", daemon=True)
        self._thread.start()
        for line in (f"listening on {written(*self.address)}", *access_lines(*self.address, self._allow)):
            self._say(f"headset: {line}")

    @property
    def connected(self) -> bool:
        """Whether a headset is connected and sends hand data.

        After a lost connection it stays False until :meth:`poll` has noticed the loss.
        """
        return self._stream.connected

    @property
    def driver(self) -> str | None:
        """The address of the headset that drives; None if no headset drives."""
        return self._stream.peer

    def poll(self, now: float) -> list[HandSample]:
        """Return the samples since the last poll, oldest first. Samples of a lost connection are left out."""
        return self._stream.take()

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Let a hand vibrate. The values are clipped to 0..1.

        Nothing happens if no headset is connected, or if a value is not finite.
        """
        values = (feedback.frequency, feedback.amplitude)
        if feedback.hand not in SIDES or not all(map(math.isfinite, values)) or self._stream.peer is None:
            return
        frequency, amplitude = (min(max(float(value), 0.0), 1.0) for value in values)
        with self._owed_lock:
            self._owed[feedback.hand] = HapticFeedback(feedback.hand, frequency, amplitude)
        self._connections.wake()

    @property
    def statistics(self) -> HeadsetStatistics:
        """A snapshot for people; see :class:`HeadsetStatistics`."""
        statistics, client = self._stream.statistics(self.address, self._clock()), self._client
        if client is None:
            return statistics
        session = client.session
        with self._session_lock:
            return replace(
                statistics,
                dialect=session.dialect,
                unknown_topics=dict(session.unknown_topics),
                published=tuple(session.published),
                subscribed=tuple(session.subscribed),
            )

    def close(self) -> None:
        """Drop the headset and stop listening. The method may be called twice."""
        if self._thread is None:
            return
        self._stop.set()
        self._connections.wake()
        self._thread.join()
        self._thread = None

    def _run(self, connections: Connections) -> None:
        while not self._stop.is_set():
            try:
                connections.serve()
            except Exception as error:
                # After any exception this thread has to go on for the next headset.
                connections.report(error)
                with suppress(Exception):
                    connections.end_all("unexpected fault of the server")
                time.sleep(TURN)
        connections.close()

    def _admit(self, client: Client) -> None:
        with self._owed_lock:
            self._owed.clear()
        self._client = client
        self._stream.admit(client.peer)

    def _receive(self, client: Client, frame: WireFrame, now: float) -> None:
        # The lock is released after each frame, so that a snapshot never waits for many frames.
        with self._session_lock:
            reception = client.receive(frame, now)
        if reception is not None:
            self._stream.receive(reception, now)

    def _take_owed(self) -> Iterable[HapticFeedback]:
        with self._owed_lock:
            owed, self._owed = self._owed, {}
        return owed.values()
