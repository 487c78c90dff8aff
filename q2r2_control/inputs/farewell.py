"""Closing a connection so that the peer can still read why."""

from __future__ import annotations

import selectors
import socket
from contextlib import suppress

from q2r2_control.inputs.session import log_frame

FAREWELL_TIME = 0.2  # [s]
MAX_FAREWELLS = 8  # at once; more are closed without

_RECEIVE_BYTES = 1 << 16


class Farewells:
    """Dismissed connections that are read and ignored for ``FAREWELL_TIME`` before they are closed.

    Closing at once, with bytes of the peer unread, would reset the connection and take the reason away from the peer.
    """

    def __init__(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector
        self._deadlines: dict[socket.socket, float] = {}

    def dismiss(self, connection: socket.socket, text: str | None, now: float) -> None:
        """Take over a non-blocking connection that the selector does not watch; ``text`` None: nothing can be said."""
        with suppress(OSError):
            if text is not None:
                connection.send(log_frame("error", text))
            connection.shutdown(socket.SHUT_WR)
        if len(self._deadlines) >= MAX_FAREWELLS:
            connection.close()
            return
        self._deadlines[connection] = now + FAREWELL_TIME
        self._selector.register(connection, selectors.EVENT_READ, lambda: self._read(connection))

    def expire(self, now: float) -> None:
        """Close those whose time is over."""
        for connection, deadline in list(self._deadlines.items()):
            if now > deadline:
                self._close(connection)

    def close(self) -> None:
        """Close all now."""
        for connection in list(self._deadlines):
            self._close(connection)

    def _read(self, connection: socket.socket) -> None:
        try:
            finished = not connection.recv(_RECEIVE_BYTES)
        except BlockingIOError:
            return
        except OSError:
            finished = True
        if finished:
            self._close(connection)

    def _close(self, connection: socket.socket) -> None:
        del self._deadlines[connection]
        self._selector.unregister(connection)
        connection.close()
