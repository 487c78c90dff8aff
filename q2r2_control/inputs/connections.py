"""Serve the clients of the headset server, in the server's thread.

It decides which client drives and which clients wait, and it receives and sends the bytes.
"""

from __future__ import annotations

import logging
import selectors
import socket
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from q2r2_control.config.strict import Network
from q2r2_control.errors import ProtocolError
from q2r2_control.inputs.listener import (
    MAX_HOSTS_NAMED,
    Peer,
    RateLimit,
    TcpListener,
    is_allowed,
    verdicts,
)
from q2r2_control.inputs.messages import KEEPALIVE, FrameDecoder, HandPose, WireFrame
from q2r2_control.inputs.session import HeadsetSession, Reception, log_frame
from q2r2_control.types import HapticFeedback

KEEPALIVE_AFTER = 1.0  # The server sends a keepalive if it has sent nothing for longer than this [s].
# A driver that sends no whole frame for longer than this is dropped [s]. The app sends a keepalive after 1 s.
SILENCE_ALLOWED = 2.0
TURN = 0.05  # Longest wait for the network. Timeouts are checked this often [s].
# Greatest number of bytes in one read, about 40 messages. The control loop can run between two reads.
_RECEIVE_BYTES = 1 << 12
MAX_FRAMES_PER_SECOND = 2000  # The app sends about 450 frames per second. Far more frames would delay the control loop.

_LOG = logging.getLogger("q2r2_control.inputs.headset")


class Client(Peer):
    """A connected client: its socket, the state of its protocol, and the times of its last frames."""

    def __init__(self, connection: socket.socket, host: str, peer: str, now: float) -> None:
        self.session = HeadsetSession()
        registrations = self.session.published, self.session.subscribed
        super().__init__(peer, host, since=now, last_frame=now, registrations=registrations)
        self.socket = connection
        self.decoder = FrameDecoder()
        self.refused_hosts: set[str] = set()  # Hosts that the log has named as refused while this client drives.
        self.announced = False  # Whether the log already says that this client is connected.
        self.last_sent = now
        self._frames = RateLimit(MAX_FRAMES_PER_SECOND)

    def receive(self, frame: WireFrame, now: float) -> Reception | None:
        """Take one frame, and return the hand's message in it; None if the frame has no such message.

        Raises:
            ProtocolError: For bytes that the protocol does not allow, and for too many frames in a second.
        """
        self.last_frame = now
        if not self._frames.take(now):
            raise ProtocolError(f"more than {MAX_FRAMES_PER_SECOND} frames in a second")
        reception = self.session.receive(frame)
        if reception is not None and isinstance(reception.message, HandPose):
            self.last_pose = now
        return reception


@dataclass(frozen=True, slots=True)
class Handlers:
    """Methods that the server's thread calls."""

    admitted: Callable[[Client], None]  # Called when a client begins to drive.
    lost: Callable[[str], None]  # Called with the reason when the driver's connection has ended.
    receive: Callable[[Client, WireFrame, float], None]  # Takes a driver's frame and time [s]. May raise ProtocolError.
    due: Callable[[], Iterable[HapticFeedback]]  # Returns the vibrations that have to be sent to the driver now.


class Connections:
    """Serves the driver and all newcomers. :func:`~q2r2_control.inputs.listener.decide` decides which client drives."""

    def __init__(
        self, door: TcpListener, allow: Sequence[Network] | None, clock: Callable[[], float], handlers: Handlers
    ) -> None:
        self._door, self._allow, self._clock, self._handlers, self._log = door, allow, clock, handlers, door.log
        self._driver: Client | None = None
        self._waiting: list[Client] = []  # Clients that wait for a decision, in the order of their arrival.
        self._unwelcome: set[str] = set()  # Hosts outside ``allow`` that the log has already named.
        self._last_fault = ""
        self._waker, self._waiter = socket.socketpair()
        self._waker.setblocking(False)
        self._waiter.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._waiter, selectors.EVENT_READ, partial(self._waiter.recv, _RECEIVE_BYTES))
        self._door_watched = False

    def wake(self) -> None:
        """Make :meth:`serve` return soon. Any thread may call this at any time."""
        # If the pipe is full, the thread wakes up anyway. If the pipe is closed, the thread has ended.
        with suppress(OSError):
            self._waker.send(b"\0")

    def serve(self) -> None:
        """Wait for the network once, for ``TURN`` at most, and handle all events."""
        # All data that were sent before this time are read before the decisions about clients. Otherwise, after this
        # thread or the whole process has stalled, a client could count as silent although it has sent data.
        asked = self._clock()
        self._watch_door(asked)
        # In this loop, a connection ends only while its own event is handled. No event of an ended connection follows.
        for key, _ in self._selector.select(TURN):
            key.data()
        self._settle(asked)
        now = self._clock()
        for client in (*self._waiting, *filter(None, (self._driver,))):
            self._send(client, now)
        self._log.flush(now)

    def report(self, error: Exception) -> None:
        """Log a fault of the server itself. If the same fault repeats, it is logged only once."""
        if repr(error) != self._last_fault:
            _LOG.error("headset server: unexpected fault, dropping the headset", exc_info=error)
        self._last_fault = repr(error)

    def end_all(self, reason: str) -> None:
        for client in (*self._waiting, *filter(None, (self._driver,))):
            self._end(client, reason)

    def close(self) -> None:
        """Close every connection and stop listening."""
        self.end_all("server closed")
        self._log.flush(float("inf"))
        for open_one in (self._door, self._waker, self._waiter, self._selector):
            open_one.close()

    def _watch_door(self, now: float) -> None:
        """Watch for new connections only while the limit of their rate allows one more.

        Further connections wait in the kernel, which takes no time of this process.
        """
        watched = self._door.accepts.is_open(now)
        if watched and not self._door_watched:
            self._selector.register(self._door, selectors.EVENT_READ, self._accept)
        elif self._door_watched and not watched:
            self._selector.unregister(self._door)
        self._door_watched = watched

    def _accept(self) -> None:
        now = self._clock()
        for connection, host, peer in self._door.arrivals(now):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client = Client(connection, host, peer, now)
            self._selector.register(connection, selectors.EVENT_READ, partial(self._receive, client))
            self._waiting.append(client)

    def _settle(self, now: float) -> None:
        """Decide which client drives. All data that were sent before ``now`` [s] have been read."""
        driver = self._driver
        if driver is not None and now - driver.last_frame > SILENCE_ALLOWED:
            self._drop(driver, f"no frame for {SILENCE_ALLOWED:g} s")  # A silent driver would keep other clients out.
        for client in tuple(self._waiting):
            if not is_allowed(client.host, self._allow):
                self._refuse(client, f"{client.host} is not in headset.allow", self._unwelcome)
        for client, admitted, reason in verdicts(self._waiting, lambda: self._driver, now):
            driver = self._driver
            if admitted:
                if driver is not None:
                    self._drop(driver, reason)
                self._waiting.remove(client)
                self._driver = client
                self._handlers.admitted(client)
            elif driver is not None:
                self._refuse(client, reason, driver.refused_hosts)

    def _refuse(self, client: Client, reason: str, named: set[str]) -> None:
        """Refuse a newcomer. The app tries again every second, so the log has only one line for each host."""
        if client.host not in named and len(named) < MAX_HOSTS_NAMED:
            named.add(client.host)
            self._write(client, logging.WARNING, f"refused: {reason}")
        self._end(client, f"refused: {reason}")

    def _receive(self, client: Client) -> None:
        try:
            data = client.socket.recv(_RECEIVE_BYTES)
            if data:
                self._handle(client, data, self._clock())
                return
            client.decoder.finish()
        except BlockingIOError:
            return
        except OSError as error:
            self._drop(client, f"connection lost: {error.strerror}")
        except ProtocolError as error:
            self._drop(client, str(error))
        except Exception as error:
            # After any exception this thread has to go on, and a fault of a newcomer must not stop the driver.
            self.report(error)
            self._drop(client, "unexpected fault of the server")
        else:
            if client.announced:
                self._write(client, logging.INFO, "closed the connection")
            self._end(client, "closed by the headset")

    def _handle(self, client: Client, data: bytes, now: float) -> None:
        client.decoder.feed(data)
        while (frame := client.decoder.next_frame()) is not None:
            if client is not self._driver:
                client.receive(frame, now)
                continue
            self._handlers.receive(client, frame, now)
            if not client.announced and client.session.dialect is not None:
                client.announced = True
                self._write(client, logging.INFO, f"connected, dialect {client.session.dialect}")

    def _send(self, client: Client, now: float) -> None:
        outgoing = client.session.outgoing
        if not outgoing and client is self._driver:
            # Vibrations are encoded only now, so that a client that reads late gets only the newest vibration.
            for vibration in self._handlers.due():
                client.session.queue_haptic(vibration)
            if not outgoing and now - client.last_sent > KEEPALIVE_AFTER:
                outgoing += KEEPALIVE
        try:
            if outgoing:
                del outgoing[: client.socket.send(outgoing)]
                client.last_sent = now
        except BlockingIOError:
            pass
        except OSError as error:
            self._drop(client, f"connection lost: {error.strerror}")
            return
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if outgoing else 0)
        key = self._selector.get_key(client.socket)
        if key.events != events:
            self._selector.modify(client.socket, events, key.data)

    def _drop(self, client: Client, reason: str) -> None:
        """End a connection from this side, with one line in the log that says why."""
        reason = " ".join(reason.split())
        self._write(client, logging.WARNING, f"dropped: {reason}")
        self._end(client, reason, f"dropped: {reason}")

    def _end(self, client: Client, reason: str, last_words: str = "") -> None:
        if client is self._driver:
            self._driver = None
            self._handlers.lost(reason)
        else:
            self._waiting.remove(client)
        self._selector.unregister(client.socket)
        with client.socket, suppress(OSError):
            # Unsent bytes are sent before the last line, since they may be the end of a frame.
            client.socket.send(bytes(client.session.outgoing) + log_frame("error", last_words or reason))

    def _write(self, client: Client, level: int, what: str) -> None:
        self._log.write(client.host, level, f"headset {client.peer} {what}", self._clock())
