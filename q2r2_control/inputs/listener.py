"""The door: connections come in at a bounded rate, one client drives, and people are told addresses. No clocks."""

from __future__ import annotations

import logging
import math
import socket
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from ipaddress import ip_address
from typing import TypeVar

from q2r2_control.config.strict import Network
from q2r2_control.inputs.addresses import reachable_addresses

LINES_PERIOD = 1.0  # between two lines about one host [s]
MAX_WAITING = 4  # newcomers of which it is not yet known whether they may drive, one of each host
MAX_HOSTS_NAMED = 8  # with lines of their own within LINES_PERIOD; all others share theirs
ONLY_THIS_MACHINE = ("127.0.0.1", "::1", "localhost")
_OTHERS = "other hosts"


class RateLimit:
    """At most ``count`` in each ``period`` [s]."""

    def __init__(self, count: int, period: float = 1.0) -> None:
        self._count, self._period = count, period
        self._start, self._taken = -math.inf, 0

    def is_open(self, now: float) -> bool:
        """Whether one more is allowed at ``now`` [s]."""
        return self._taken < self._count or now - self._start >= self._period

    def take(self, now: float) -> bool:
        if now - self._start >= self._period:
            self._start, self._taken = now, 0
        if self._taken >= self._count:
            return False
        self._taken += 1
        return True


@dataclass
class _Host:
    since: float  # of its last line
    level: int = 0
    text: str = ""  # the most important line held back, the newest of those
    held_back: int = 0


class HostLog:
    """Writes at most one line a second about each host.

    A line that comes too early is held back. When the second is over, the newest of the most important ones is
    written, with the number of those left out.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._hosts: dict[str, _Host] = {}

    def write(self, host: str, level: int, text: str, now: float) -> None:
        """Write, or hold back, a line about ``host``; ``level`` is one of ``logging``."""
        self.flush(now)
        if host not in self._hosts and len(self._hosts) >= MAX_HOSTS_NAMED:
            host = _OTHERS
        known = self._hosts.get(host)
        if known is None:
            self._hosts[host] = _Host(now)
            self._write(level, text)
            return
        known.held_back += 1
        if level >= known.level:
            known.level, known.text = level, text

    def flush(self, now: float) -> None:
        """Write the lines whose second is over; all of them at ``now`` = inf."""
        for host, known in list(self._hosts.items()):
            if now - known.since >= LINES_PERIOD:
                del self._hosts[host]
                if known.held_back:
                    left_out = known.held_back - 1
                    self._write(known.level, known.text + (f" ({left_out} more left out)" if left_out else ""))
                    self._hosts[host] = _Host(now)

    def _write(self, level: int, text: str) -> None:
        self._logger.log(level, "%s", text)  # the text is no format: it may quote what a client sent


# Taking a connection costs the interpreter, and so the control loop, some 0.1 ms. A client in the kernel's queue of 128
# is taken within 0.35 s. When that is full, the kernel drops new ones, and the client tries again after 1 s.
ACCEPTS, ACCEPTS_PERIOD = 20, 0.05  # [s]
ANSWERS_PER_SECOND = 10  # to one host; the app connects once a second
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: close with a reset, which leaves nothing behind in the kernel


class TcpListener:
    """Listens on ``host`` and ``port``. Raises OSError, OverflowError or ValueError where that is not possible.

    A host that connects more than ``ANSWERS_PER_SECOND`` is closed without a word, which costs least.
    """

    def __init__(self, host: str, port: int, log: HostLog) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        self._socket = socket.create_server((host, port), family=family, dualstack_ipv6=both)  # with SO_REUSEADDR
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])  # that was bound
        self.log = log
        self.accepts = RateLimit(ACCEPTS, ACCEPTS_PERIOD)  # while it is not open, there is no use in waiting
        self._answers: dict[str, RateLimit] = {}
        self._answers_since = -math.inf

    def fileno(self) -> int:
        return self._socket.fileno()

    def arrivals(self, now: float) -> Iterator[tuple[socket.socket, str, str]]:
        """Connections within the rate: a socket that does not block, host (IPv4 through IPv6 as IPv4), and peer."""
        while self.accepts.take(now):
            try:
                connection, address = self._socket.accept()
            except BlockingIOError:
                return
            except OSError as error:  # out of file descriptors, or the peer has gone again
                logging.getLogger(__name__).debug("accept: %s", error)
                continue
            host = str(getattr(ip_address(address[0]), "ipv4_mapped", None) or address[0])
            if now - self._answers_since >= 1.0:
                self._answers_since = now
                self._answers.clear()
            if self._answers.setdefault(host, RateLimit(ANSWERS_PER_SECOND)).take(now):
                connection.setblocking(False)
                yield connection, host, written(host, address[1])
                continue
            with connection, suppress(OSError):
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            refused = f"headset {host} connects more than {ANSWERS_PER_SECOND} times a second: not answered"
            self.log.write(host, logging.WARNING, refused, now)

    def close(self) -> None:
        self._socket.close()


def written(host: str, port: int) -> str:
    """Host and port in one text, as ``[::1]:10000`` with IPv6."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def app_settings(host: str, port: int) -> str:
    """The app's settings, for a server that listens on ``host``."""
    return f"address {' or '.join(reachable_addresses(host))}, port {port}, protocol ROS2"


def access_lines(host: str, port: int, allow: Sequence[Network] | None) -> tuple[str, ...]:
    """The app's settings, and who can drive now, for a server that listens on ``host``."""
    if host in ONLY_THIS_MACHINE:
        return (f"{host} can be reached from this machine only; --host 0.0.0.0 admits the network",)
    if allow is None:
        drivers = (
            "whoever reaches this port can drive the arms; headset.allow in the cell's YAML restricts it, such as to "
            "[192.168.1.0/24]"
        )
    else:
        drivers = f"only {', '.join(map(str, allow))} can drive the arms (headset.allow in the cell's YAML)"
    return (f"enter in the app: {app_settings(host, port)}", drivers)


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach an address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


# Rules 1 to 4 are those of docs/headset.md, "Who drives". A quiet driver gives way only to its own peer, after 37
# periods of the app's poses, three times as long as the time that pauses the arms. A silently lost link looks alive for
# seconds.
QUIET_ALLOWED = 0.5  # without a frame, against the same peer on a new connection [s]
POSES_ALLOWED = 5.0  # without a hand pose, against a client that sends them [s]
WAIT_ALLOWED = 2.0  # for a newcomer to show what gives it the place [s]


@dataclass
class Peer:
    """The known facts about a connected client."""

    peer: str  # address and port, for people
    host: str  # address
    since: float  # when it connected [s]
    last_frame: float  # when its last whole frame was received [s]
    last_pose: float = -math.inf  # when its last hand pose was received [s]
    registrations: Sequence[Mapping[str, str]] = ({}, {})  # topics that it publishes, and that it listens to


SomePeer = TypeVar("SomePeer", bound=Peer)


class Admission(Enum):
    ADMIT = "admit"  # drives from now on, instead of the driver if there is one
    WAIT = "wait"  # may stay, unheard, until more is known
    REFUSE = "refuse"


def decide(driver: Peer | None, newcomer: Peer, now: float) -> tuple[Admission, str]:
    """The admission of ``newcomer`` at ``now`` [s] by rules 2 to 4, and why it, or the ``driver``, gets no place."""
    if driver is None:
        return Admission.ADMIT, ""
    if now - driver.last_pose > POSES_ALLOWED:
        if newcomer.last_pose > -math.inf:
            return Admission.ADMIT, f"no hand pose for {POSES_ALLOWED:g} s, and {newcomer.peer} sends them"
    elif newcomer.host == driver.host and now - driver.last_frame > QUIET_ALLOWED:
        if any(newcomer.registrations) and newcomer.registrations == driver.registrations:
            return Admission.ADMIT, f"no frame for {QUIET_ALLOWED:g} s, and it came back as {newcomer.peer}"
    else:
        return Admission.REFUSE, f"{driver.peer} drives"
    if now - newcomer.since > WAIT_ALLOWED:
        return Admission.REFUSE, f"{driver.peer} is connected"
    return Admission.WAIT, ""


def verdicts(
    waiting: Sequence[SomePeer], driver: Callable[[], SomePeer | None], now: float
) -> Iterator[tuple[SomePeer, bool, str]]:
    """Each newcomer that is admitted (True) or refused at ``now`` [s], and why it, or the driver, gets no place.

    Others go on waiting: the newest of each host, and ``MAX_WAITING`` at most. The ``driver`` may change meanwhile.
    """
    newest = {client.host: client for client in waiting}
    still_waiting = 0
    for client in tuple(waiting):
        current = driver()
        verdict, reason = decide(current, client, now)
        if verdict is Admission.ADMIT:
            yield client, True, reason
        elif verdict is Admission.REFUSE or newest[client.host] is not client or still_waiting == MAX_WAITING:
            assert current is not None  # without one, everybody is admitted
            yield client, False, reason or f"{current.peer} is connected"
        else:
            still_waiting += 1


def is_allowed(host: str, networks: Sequence[Network] | None) -> bool:
    """Whether the address ``host`` lies in one of ``networks``; None admits all (rule 1)."""
    return networks is None or any(ip_address(host) in network for network in networks)
