"""Follow the ROS-TCP-Connector 0.7 protocol in the session of one client, without sockets, threads or clocks."""

from __future__ import annotations

import json
import re
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any, NamedTuple

from q2r2_control.errors import ProtocolError
from q2r2_control.inputs.messages import (
    Dialect,
    HandMessage,
    MessageType,
    WireFrame,
    decode,
    encode,
    encode_frame,
    fits,
)
from q2r2_control.types import SIDES, HandFault, HapticFeedback

MAX_OUTGOING_BYTES = 1 << 16  # Greatest size of the answers that a client may leave unread.
MAX_COMMAND_BYTES = 1 << 14  # Greatest length of a system command's JSON. The app's commands have under 200 bytes.
MAX_TOPICS = 64  # Greatest number of topics that a client may name. The app names about ten.
MAX_INCOMPLETE = 64  # Greatest number of registrations without topic or type in one session.


class HandTopic(NamedTuple):
    """A topic that the app publishes."""

    hand: str
    kind: MessageType  # Type of the messages.


HAND_TOPICS = {
    f"q2r_{hand}_hand_{suffix}": HandTopic(hand, kind)
    for hand in SIDES
    for suffix, kind in (("pose", MessageType.POSE), ("twist", MessageType.TWIST), ("inputs", MessageType.INPUTS))
}
HAPTIC_TOPICS = {hand: f"q2r_{hand}_hand_haptic_feedback" for hand in SIDES}

_TOPIC_TYPES: dict[str, str] = {
    **{name: topic.kind.value for name, topic in HAND_TOPICS.items()},
    **dict.fromkeys(HAPTIC_TOPICS.values(), MessageType.HAPTIC.value),
}
_TOPIC_NAME = re.compile(r"[A-Za-z~_][A-Za-z0-9_~/]{0,255}")


class Reception(NamedTuple):
    """One message of a hand."""

    topic: str  # Name without leading slash.
    hand: str
    message: HandMessage
    fault: HandFault | None = None  # The fault that the headset itself reports for a pose.
    virtual: bool = False  # True if keys or a gamepad move the hand. The pose of a hand at rest then has no noise.


def log_frame(level: str, text: str) -> bytes:
    """Return a frame that writes a line to the app's console. ``level`` is log, warn or error."""
    return encode_frame(f"__{level}", json.dumps({"text": text}).encode())


# The first frame that the server sends. If it were another frame, the app would ignore it, because it would assume that
# the server has another version.
HANDSHAKE = encode_frame(
    "__handshake",
    json.dumps({"version": "v0.7.0", "metadata": json.dumps({"protocol": Dialect.ROS2.value})}).encode(),
)


class _IncompleteRegistrationError(Exception):
    """Raised if a command names no topic or no type, because the app's user has left a field empty."""


class HeadsetSession:
    """The protocol state of one client. :meth:`receive` takes its frames. :attr:`outgoing` has the bytes to send.

    The server sends the first frame, in the dialect ROS2, before it knows the client's dialect. An app that is set to
    ROS1 logs an error and goes on. The client's first frame shows its dialect: only ROS2 clients put a NUL behind every
    destination. Each payload then has to fit this dialect, so that the dialect is never guessed.

    Data on topics outside ``HAND_TOPICS`` is counted and ignored. A registration whose topic or type the app's user
    left empty gets an error for the app's console, as from Unity's own endpoint. An unknown command, a name that no
    topic can have, and a payload that does not fit its topic raise a :class:`ProtocolError`. They show that the two
    sides do not use the same protocol.
    """

    def __init__(self) -> None:
        self.dialect: Dialect | None = None
        self.published: dict[str, str] = {}  # Topic without leading slash -> type, as registered.
        self.subscribed: dict[str, str] = {}  # Topic without leading slash -> the name as the client writes it.
        self.unknown_topics: Counter[str] = Counter()  # Number of messages on topics outside ``HAND_TOPICS``.
        self.outgoing = bytearray(HANDSHAKE)
        self._skip_body = False  # Whether the next frame is the body of a service call, which is ignored.
        self._incomplete = 0  # Number of registrations without topic or type so far.

    def receive(self, frame: WireFrame) -> Reception | None:
        """Take one frame, and return the hand's message in it; None if the frame has no such message.

        Raises:
            ProtocolError: If the client has to be dropped.
        """
        if not frame.destination and not frame.payload:
            return None  # The frame is a keepalive.
        dialect = Dialect.ROS2 if frame.terminated else Dialect.ROS1
        if dialect is not (self.dialect or dialect):
            raise ProtocolError(
                f"destination {frame.destination!r:.60} ends {'with' if frame.terminated else 'without'} NUL, which "
                f"is the {dialect} dialect; earlier ones were {self.dialect}"
            )
        self.dialect = dialect
        if self._skip_body:
            self._skip_body = False
            return None
        if frame.destination.startswith("__"):
            try:
                self._command(frame)
            except _IncompleteRegistrationError as error:
                self._incomplete += 1
                if self._incomplete > MAX_INCOMPLETE:
                    raise ProtocolError(f"more than {MAX_INCOMPLETE} registrations without topic or type") from error
                self._answer("__error", {"text": str(error)})
            return None
        return self._data(frame, dialect)

    def queue_haptic(self, vibration: HapticFeedback) -> None:
        """Add a vibration to the outgoing bytes, if the client listens to vibrations; otherwise nothing happens."""
        destination = self.subscribed.get(HAPTIC_TOPICS[vibration.hand])
        if destination is not None and self.dialect is not None:
            self.outgoing += encode_frame(destination, encode(vibration, self.dialect))

    def _data(self, frame: WireFrame, dialect: Dialect) -> Reception | None:
        name = _topic_name(frame.destination)
        topic = HAND_TOPICS.get(name)
        if topic is None:
            if name in self.unknown_topics or len(self.unknown_topics) < MAX_TOPICS:
                self.unknown_topics[name] += 1
            return None
        if fits(topic.kind, frame.payload, dialect.other):
            raise ProtocolError(
                f"{name}: {len(frame.payload)} bytes are a message of the {dialect.other} dialect, "
                f"but the destination is written as in {dialect}"
            )
        try:
            return Reception(name, topic.hand, decode(topic.kind, frame.payload, dialect))
        except ProtocolError as error:
            raise ProtocolError(f"{name}: {error}") from error

    def _command(self, frame: WireFrame) -> None:
        command = frame.destination
        parameters = _parameters(command, frame.payload)
        match command:
            case "__publish" | "__subscribe" | "__remove_publisher" | "__remove_subscriber":
                self._register(command, parameters)
            case "__topic_list":
                types = _TOPIC_TYPES | self.published
                names = [f"/{name}" for name in types]  # Names in the ROS graph begin with a slash.
                self._answer("__topic_list", {"topics": names, "types": list(types.values())})
            case "__ros_service" | "__unity_service" | "__remove_ros_service" | "__remove_unity_service":
                pass  # These commands have no effect, because q2r2 has no services.
            case "__request" | "__response":
                self._skip_body = True
                if command == "__request":
                    self._answer("__error", {"text": "__request: q2r2 offers no services"})
            case _:
                raise ProtocolError(f"unknown system command {command!r:.60}")

    def _register(self, command: str, parameters: dict[str, Any]) -> None:
        """Register or remove a topic. The app may register the same topic again at any time."""
        written = _text(command, parameters, "topic")
        topic = _topic_name(written)
        registrations = self.published if "publish" in command else self.subscribed
        if command.startswith("__remove"):
            registrations.pop(topic, None)
            return
        kind = _text(command, parameters, "message_name", f" of {topic}")
        registrations[topic] = kind if registrations is self.published else written
        if len(registrations) > MAX_TOPICS:
            raise ProtocolError(f"more than {MAX_TOPICS} topics registered")

    def _answer(self, command: str, parameters: dict[str, Any]) -> None:
        self.outgoing += encode_frame(command, json.dumps(parameters).encode())
        if len(self.outgoing) > MAX_OUTGOING_BYTES:
            raise ProtocolError(f"over {MAX_OUTGOING_BYTES} bytes of answers left unread")


def _parameters(command: str, payload: bytes) -> dict[str, Any]:
    """Return the JSON object of a system command. JSON with too deep nesting or too long numbers is refused."""
    if len(payload) > MAX_COMMAND_BYTES:
        raise ProtocolError(f"{command!r:.60}: {len(payload)} bytes, at most {MAX_COMMAND_BYTES} are allowed")
    try:
        parameters = json.loads(payload.removesuffix(b"\0").decode() or "{}")
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"{command!r:.60}: {payload[:60]!r} is not JSON: {error}") from None
    if not isinstance(parameters, dict):
        raise ProtocolError(f"{command!r:.60}: {payload[:60]!r} is not a JSON object")
    return parameters


def _text(command: str, parameters: dict[str, Any], key: str, whose: str = "") -> str:
    value = parameters.get(key)
    if value is not None and not isinstance(value, str):
        raise ProtocolError(f"{command}: {key} is a string, got a {type(value).__name__}")
    if not value or value.isspace():
        raise _IncompleteRegistrationError(f"{command}: {key}{whose} is empty; this registration is left out")
    return value


def _topic_name(name: str) -> str:
    """Return the name without its leading slash, which is optional."""
    bare = name.removeprefix("/")
    if not _TOPIC_NAME.fullmatch(bare):
        raise ProtocolError(f"{name!r:.60} is not a topic name")
    return bare


_STAMPS_KEPT = 1000  # Number of times of receipt that are kept per topic. No headset sends this many messages a second.


@dataclass(frozen=True, slots=True)
class TopicStatistics:
    """The messages of one topic since the app connected."""

    count: int
    rate: float  # Messages in the last second [Hz].
    age: float  # Time since the last message [s].
    last: HandMessage


@dataclass(frozen=True, slots=True)
class HeadsetStatistics:
    """A snapshot of the server. If no headset is connected, dialect and topics belong to the last connection."""

    address: tuple[str, int]  # Bound host and port.
    peer: str | None  # Host and port of the connected headset, as host:port; None if there is none.
    dialect: Dialect | None
    topics: dict[str, TopicStatistics]
    unknown_topics: dict[str, int]  # Number of messages on each topic that the server does not know, by topic.
    published: tuple[str, ...]  # Topics that the app announced.
    subscribed: tuple[str, ...]  # Topics that the app listens to.
    connections: int  # Number of connections since the server was started.
    last_disconnect: str | None  # Why the last connection ended; None if no connection has ended.


class TopicRecorder:
    """Counts the messages of one topic, and keeps the last one. Times are receipt times [s]."""

    _last: HandMessage

    def __init__(self) -> None:
        self._stamps: deque[float] = deque(maxlen=_STAMPS_KEPT)
        self._count = 0

    def record(self, message: HandMessage, now: float) -> None:
        self._stamps.append(now)
        self._count += 1
        self._last = message

    def snapshot(self, now: float) -> TopicStatistics:
        """Return the statistics at ``now`` [s]. At least one message has to be recorded before this call."""
        rate = float(sum(stamp > now - 1.0 for stamp in self._stamps))
        return TopicStatistics(self._count, rate, now - self._stamps[-1], self._last)
