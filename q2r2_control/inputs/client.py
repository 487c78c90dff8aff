"""The state of the connected headset in the server."""

from __future__ import annotations

import socket

from q2r2_control.errors import ProtocolError
from q2r2_control.inputs.framing import FrameDecoder
from q2r2_control.inputs.samples import HandTracker
from q2r2_control.inputs.session import HeadsetSession, Reception
from q2r2_control.inputs.statistics import TopicRecorder

MAX_FRAMES_PER_SECOND = 2000  # the app sends about 450; more would take processor time from the control loop


class Client:
    """The connected headset."""

    def __init__(self, connection: socket.socket, peer: str, now: float) -> None:
        self.socket = connection
        self.peer = peer
        self.session = HeadsetSession()
        self.decoder = FrameDecoder()
        self.tracker = HandTracker()
        self.recorders: dict[str, TopicRecorder] = {}
        self.refused_hosts: set[str] = set()
        self.last_frame = now
        self.last_sent = now
        self._window_start = now
        self._window_frames = 0

    def count_frame(self, now: float) -> None:
        """Raises :class:`ProtocolError` when the client floods."""
        self.last_frame = now
        if now - self._window_start >= 1.0:
            self._window_start, self._window_frames = now, 0
        self._window_frames += 1
        if self._window_frames > MAX_FRAMES_PER_SECOND:
            raise ProtocolError(f"more than {MAX_FRAMES_PER_SECOND} frames in a second")

    def record(self, reception: Reception, now: float) -> None:
        self.recorders.setdefault(reception.topic, TopicRecorder()).record(reception.message, now)
