"""The state of a connected client in the server."""

from __future__ import annotations

import socket

from q2r2_control.errors import ProtocolError
from q2r2_control.inputs.admission import Peer
from q2r2_control.inputs.framing import FrameDecoder, WireFrame
from q2r2_control.inputs.messages import HandPose
from q2r2_control.inputs.rate_limits import RateLimit
from q2r2_control.inputs.samples import HandTracker
from q2r2_control.inputs.session import HeadsetSession, Reception
from q2r2_control.inputs.statistics import TopicRecorder

MAX_FRAMES_PER_SECOND = 2000  # the app sends about 450; more would take processor time from the control loop


class Client(Peer):
    """A connected client."""

    def __init__(self, connection: socket.socket, host: str, peer: str, now: float) -> None:
        self.session = HeadsetSession()
        registrations = self.session.published, self.session.subscribed
        super().__init__(peer, host, since=now, last_frame=now, registrations=registrations)
        self.socket = connection
        self.decoder = FrameDecoder()
        self.tracker = HandTracker()
        self.recorders: dict[str, TopicRecorder] = {}
        self.refused_hosts: set[str] = set()
        self.announced = False  # in the log
        self.last_sent = now
        self._frames = RateLimit(MAX_FRAMES_PER_SECOND)

    def receive(self, frame: WireFrame, now: float) -> Reception | None:
        """Take one frame; the hand's message if it was one.

        Raises :class:`ProtocolError` when the client breaks the protocol or floods.
        """
        self.last_frame = now
        if not self._frames.take(now):
            raise ProtocolError(f"more than {MAX_FRAMES_PER_SECOND} frames in a second")
        reception = self.session.receive(frame)
        if reception is not None and isinstance(reception.message, HandPose):
            self.last_pose = now
        return reception

    def record(self, reception: Reception, now: float) -> None:
        """Count a message for people to see."""
        self.recorders.setdefault(reception.topic, TopicRecorder()).record(reception.message, now)
