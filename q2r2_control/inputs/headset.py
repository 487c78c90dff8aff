"""The TCP server that the Quest2ROS app connects to: one background thread, one headset at a time, no ROS."""

from __future__ import annotations

import logging
import math
import selectors
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np

from q2r2_control.errors import InputError, ProtocolError
from q2r2_control.inputs.client import Client
from q2r2_control.inputs.messages import PROP_TOPICS, AppMessage, PropTwist, warm_up
from q2r2_control.inputs.samples import SampleQueue
from q2r2_control.inputs.session import HANDSHAKE, Reception, log_frame, topic_of
from q2r2_control.inputs.statistics import HeadsetStatistics
from q2r2_control.types import SIDES, HandSample, HapticFeedback

KEEPALIVE_AFTER = 1.0  # of own silence [s]
SILENCE_ALLOWED = 2.0  # without a whole frame [s]; the app sends a keepalive after 1 s
MAX_HOSTS_NAMED = 8  # in the log as refused while one headset drives
_TURN = 0.05  # longest wait for the network; timeouts are looked at this often [s]
_RECEIVE_BYTES = 1 << 12  # some 40 messages: the control loop gets the interpreter between two such portions

_LOG = logging.getLogger(__name__)


class HeadsetServer:
    """Hand samples from, and vibrations to, the Quest2ROS app. Implements :class:`~q2r2_control.inputs.base.Input`.

    Samples are stamped with ``clock`` when their bytes are received. The loop's thread never waits for the network
    or for decoding. A client that breaks the protocol, floods, or is silent for ``SILENCE_ALLOWED`` is dropped with one
    logged line, and another one may connect; while one is connected, others are refused.

    Where a ``listener`` is given, each message goes only to it, at once and in the receiving thread, and :meth:`poll`
    returns nothing: this is for forwarding messages one by one.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 10000,
        clock: Callable[[], float] = time.monotonic,
        listener: Callable[[Reception], None] | None = None,
    ) -> None:
        self._address = (host, port)
        self._clock = clock
        self._tell = listener
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._samples = SampleQueue()
        self._owed: dict[str, AppMessage] = {}  # the newest message of each topic
        self._owed_lock = threading.Lock()
        self._statistics_lock = threading.Lock()  # never taken by poll or what sends
        self._client: Client | None = None
        self._last_client: Client | None = None
        self._connections = 0
        self._last_disconnect: str | None = None

    def start(self) -> None:
        """Listen. Raises :class:`InputError` when host and port cannot be bound, or when already started."""
        if self._thread is not None:
            raise InputError(f"headset: already listening on {self._address[0]}:{self._address[1]}")
        warm_up()
        host, port = self._address
        try:
            self._listener = socket.create_server(self._address)  # with SO_REUSEADDR
        except (OSError, OverflowError, ValueError) as error:
            raise InputError(f"headset: cannot listen on {host}:{port}: {error}") from error
        self._listener.setblocking(False)
        self._address = (host, self._listener.getsockname()[1])
        self._waker, self._waiter = socket.socketpair()
        self._waker.setblocking(False)
        self._waiter.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        self._selector.register(self._waiter, selectors.EVENT_READ, self._drain_waiter)
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name="headset", daemon=True)
        self._thread.start()

    @property
    def address(self) -> tuple[str, int]:
        """Host and port; after ``start`` the port that was bound."""
        return self._address

    @property
    def connected(self) -> bool:
        """Whether a headset is connected, and no loss is left that ``poll`` has not shown yet."""
        return self._client is not None and not self._samples.is_cut

    def poll(self, now: float) -> list[HandSample]:
        """Samples since the last poll, oldest first. None of a lost connection: those poses are not the hand's."""
        return self._samples.take()

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Vibrate, values clipped to 0..1; nothing happens unless a headset listens, or when a value is not finite."""
        values = (feedback.frequency, feedback.amplitude)
        if feedback.hand in SIDES and all(map(math.isfinite, values)):
            frequency, amplitude = (min(max(float(value), 0.0), 1.0) for value in values)
            self._owe(HapticFeedback(feedback.hand, frequency, amplitude))

    def send_twist(self, twist: PropTwist) -> None:
        """Move a thing in the app; nothing happens unless a headset listens, or when a value is not finite."""
        if twist.topic in PROP_TOPICS and np.isfinite([twist.linear, twist.angular]).all():
            self._owe(twist)

    @property
    def statistics(self) -> HeadsetStatistics:
        """A snapshot for people; see :class:`HeadsetStatistics`."""
        now = self._clock()
        with self._statistics_lock:
            client, last = self._client, self._last_client
            session = last.session if last else None
            return HeadsetStatistics(
                address=self._address,
                peer=client.peer if client else None,
                dialect=session.dialect if session else None,
                topics={name: recorder.snapshot(now) for name, recorder in last.recorders.items()} if last else {},
                unknown_topics=dict(session.unknown_topics) if session else {},
                published=tuple(session.published) if session else (),
                subscribed=tuple(session.subscribed) if session else (),
                connections=self._connections,
                last_disconnect=self._last_disconnect,
            )

    def close(self) -> None:
        """Drop the headset and stop listening; may be called twice."""
        if self._thread is None:
            return
        self._stop.set()
        self._wake()
        self._thread.join()
        self._thread = None

    def _owe(self, message: AppMessage) -> None:
        if self._client is not None:
            with self._owed_lock:
                self._owed[topic_of(message)] = message
            self._wake()

    def _wake(self) -> None:
        # A full pipe wakes the thread as well; with a closed one there is no thread.
        with suppress(OSError):
            self._waker.send(b"\0")

    def _run(self) -> None:
        last_fault = ""
        while not self._stop.is_set():
            try:
                self._serve_once()
            except Exception as error:
                # After any exception this thread has to go on for the next headset; the client is dropped.
                if repr(error) != last_fault:
                    _LOG.exception("headset server: unexpected fault, dropping the headset")
                last_fault = repr(error)
                with suppress(Exception):
                    self._disconnect("unexpected fault of the server")
                time.sleep(_TURN)
        self._disconnect("server closed")
        for open_socket in (self._listener, self._waker, self._waiter):
            open_socket.close()
        self._selector.close()

    def _serve_once(self) -> None:
        """Wait for the network once and handle what there is."""
        for key, _ in self._selector.select(_TURN):
            key.data()
        now = self._clock()
        if self._client is not None:
            self._send_due(self._client, now)

    def _drain_waiter(self) -> None:
        self._waiter.recv(_RECEIVE_BYTES)

    def _accept(self) -> None:
        try:
            connection, address = self._listener.accept()
        except OSError as error:
            # Out of file descriptors, or the peer has gone again. The listener stays readable: do not spin.
            _LOG.debug("headset server: accept: %s", error)
            time.sleep(0.01)
            return
        connection.setblocking(False)
        peer = f"{address[0]}:{address[1]}"
        driving = self._client
        if driving is not None:
            # The app tries again every second: one line for each host is enough.
            if address[0] not in driving.refused_hosts and len(driving.refused_hosts) < MAX_HOSTS_NAMED:
                driving.refused_hosts.add(address[0])
                _LOG.warning("headset %s refused: %s drives", peer, driving.peer)
            _close_with(connection, HANDSHAKE + log_frame("error", f"refused: {driving.peer} drives"))
            return
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = Client(connection, peer, self._clock())
        self._selector.register(connection, selectors.EVENT_READ, lambda: self._receive(client))
        with self._owed_lock:
            self._owed.clear()
        with self._statistics_lock:
            self._client = self._last_client = client
            self._connections += 1
        _LOG.info("headset %s connected", peer)

    def _receive(self, client: Client) -> None:
        if client is not self._client:
            return
        try:
            data = client.socket.recv(_RECEIVE_BYTES)
            if data:
                self._handle(client, data, self._clock())
                return
            client.decoder.finish()
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(f"connection lost: {error.strerror}")
        except ProtocolError as error:
            self._drop(str(error))
        else:
            _LOG.info("headset %s closed the connection", client.peer)
            self._disconnect("closed by the headset")

    def _handle(self, client: Client, data: bytes, now: float) -> None:
        client.decoder.feed(data)
        while (frame := client.decoder.next_frame()) is not None:
            client.count_frame(now)
            # Locked for each frame, so that a snapshot never waits for a whole burst.
            with self._statistics_lock:
                reception = client.session.receive(frame)
                if reception is not None:
                    client.record(reception, now)
            if reception is None:
                continue
            if self._tell is not None:
                self._tell(reception)
            elif (sample := client.tracker.update(reception.hand, reception.message, now)) is not None:
                self._samples.put(sample)

    def _send_due(self, client: Client, now: float) -> None:
        """Send what is due, and drop a silent client: its half-open connection would keep others out."""
        if now - client.last_frame > SILENCE_ALLOWED:
            self._drop(f"no frame for {SILENCE_ALLOWED:g} s")
            return
        outgoing = client.session.outgoing
        if not outgoing:
            # Encoded only now, so that a client that does not read gets the newest vibration and not all of them.
            with self._owed_lock:
                owed, self._owed = self._owed, {}
            for message in owed.values():
                client.session.queue_message(message)
            if not outgoing and now - client.last_sent > KEEPALIVE_AFTER:
                client.session.queue_keepalive()
        try:
            if outgoing:
                del outgoing[: client.socket.send(outgoing)]
                client.last_sent = now
        except BlockingIOError:
            pass
        except OSError as error:
            self._drop(f"connection lost: {error.strerror}")
            return
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if outgoing else 0)
        key = self._selector.get_key(client.socket)
        if key.events != events:
            self._selector.modify(client.socket, events, key.data)

    def _drop(self, reason: str) -> None:
        """End the connection from this side, with one logged line that says why."""
        if self._client is not None:
            reason = " ".join(reason.split())
            _LOG.warning("headset %s dropped: %s", self._client.peer, reason)
            self._disconnect(reason)

    def _disconnect(self, reason: str) -> None:
        client = self._client
        if client is None:
            return
        self._samples.cut()  # before _client, so that `connected` cannot be true of the next one too early
        with self._statistics_lock:
            self._client = None
            self._last_disconnect = reason
        self._selector.unregister(client.socket)
        # Behind what was left unsent, which may be the end of a frame.
        _close_with(client.socket, bytes(client.session.outgoing) + log_frame("error", f"dropped: {reason}"))


def _close_with(connection: socket.socket, last_words: bytes) -> None:
    """Close, after ``last_words`` if they can be sent at once."""
    with connection, suppress(OSError):
        connection.send(last_words)
