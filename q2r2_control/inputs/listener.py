"""Accept connections at a bounded rate, decide which client drives, and tell people the addresses.

Nothing here reads a clock: the caller passes the time.
"""

from __future__ import annotations

import logging
import math
import os
import socket
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from ipaddress import ip_address
from typing import TypeVar

from q2r2_control.config.strict import Network
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.addresses import reachable_addresses

LINES_PERIOD = 1.0  # Least time between two lines of the log about one host [s].
MAX_WAITING = 4  # Greatest number of clients that wait for a decision. Each host has at most one of them.
# Greatest number of hosts that the log names within LINES_PERIOD. All further hosts together count as one.
MAX_HOSTS_NAMED = 8
ONLY_THIS_MACHINE = ("127.0.0.1", "::1", "localhost")
_OTHERS = "other hosts"


class RateLimit:
    """A limit of at most ``count`` events in each ``period`` [s]."""

    def __init__(self, count: int, period: float = 1.0) -> None:
        self._count, self._period = count, period
        self._start, self._taken = -math.inf, 0

    def is_open(self, now: float) -> bool:
        """Return whether one more event is allowed at ``now`` [s]. The event is not counted."""
        return self._taken < self._count or now - self._start >= self._period

    def take(self, now: float) -> bool:
        """Count an event at ``now`` [s] if it is allowed. Return whether it is allowed."""
        if now - self._start >= self._period:
            self._start, self._taken = now, 0
        if self._taken >= self._count:
            return False
        self._taken += 1
        return True


@dataclass
class _Host:
    since: float  # Time at which the last line about this host was written [s].
    level: int = 0  # Highest level of the lines that are held back.
    text: str = ""  # The newest line of this level that is held back.
    held_back: int = 0  # Number of lines that are held back.


class HostLog:
    """Writes at most one line a second about each host.

    A line that comes too early is held back. When the second is over, one of these lines is written: the newest line of
    the highest level. It ends with the number of the lines that are left out.
    """

    def __init__(self, logger: logging.Logger) -> None:
        self._logger = logger
        self._hosts: dict[str, _Host] = {}

    def write(self, host: str, level: int, text: str, now: float) -> None:
        """Write a line about ``host``, or hold it back. ``level`` is a level of the package ``logging``."""
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
        """Write one of the lines that are held back, for each host whose last line is at least ``LINES_PERIOD`` old.

        With ``now`` = inf, this is done for all hosts.
        """
        for host, known in list(self._hosts.items()):
            if now - known.since >= LINES_PERIOD:
                del self._hosts[host]
                if known.held_back:
                    left_out = known.held_back - 1
                    self._write(known.level, known.text + (f" ({left_out} more left out)" if left_out else ""))
                    self._hosts[host] = _Host(now)

    def _write(self, level: int, text: str) -> None:
        # The text is not the format string, because it can contain words of a client.
        self._logger.log(level, "%s", text)


# Accepting a connection occupies the interpreter for about 0.1 ms, and the control loop cannot run meanwhile. At the
# following rate, a client in the kernel's queue of 128 waits 0.35 s at most. If the queue is full, the kernel drops a
# new client, which tries again after 1 s.
ACCEPTS, ACCEPTS_PERIOD = 20, 0.05  # At most this many connections are accepted in this period [s].
ANSWERS_PER_SECOND = 10  # Greatest number of answers to one host in a second. The app connects once a second.
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: close with a reset, which leaves nothing behind in the kernel.


class TcpListener:
    """Listens on ``host`` and ``port``; raises OSError, OverflowError or ValueError if they cannot be bound.

    If a host connects more than ``ANSWERS_PER_SECOND`` times in a second, its further connections are closed without an
    answer, because this takes the least time.
    """

    def __init__(self, host: str, port: int, log: HostLog) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        both = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        # The option SO_REUSEADDR is set by create_server itself.
        self._socket = socket.create_server((host, port), family=family, dualstack_ipv6=both)
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])  # The port that was bound.
        self.log = log
        self.accepts = RateLimit(ACCEPTS, ACCEPTS_PERIOD)  # While this limit is reached, no connection is accepted.
        self._answers: dict[str, RateLimit] = {}
        self._answers_since = -math.inf

    def fileno(self) -> int:
        return self._socket.fileno()

    def arrivals(self, now: float) -> Iterator[tuple[socket.socket, str, str]]:
        """Yield the connections that the rate allows: a socket that does not block, the host, and the peer's host:port.

        The host of an IPv4 connection through an IPv6 socket is an IPv4 address.
        """
        while self.accepts.take(now):
            try:
                connection, address = self._socket.accept()
            except BlockingIOError:
                return
            except OSError as error:  # There are no file descriptors left, or the peer has gone again.
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
    """Return host and port as one text, such as ``[::1]:10000`` for IPv6."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def why_not_bound(error: Exception) -> str:
    """Return why an address cannot be bound. An OSError's own text is not used, because it repeats the address."""
    return os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)


def listening_socket(host: str, port: int, option: str) -> socket.socket:
    """Return a socket for a page, which listens on ``host`` and ``port``. A ``port`` of 0 stands for any free port.

    Raises:
        ConfigError: If the address cannot be bound. The message begins with ``option``.
    """
    try:
        ipv6 = ":" in host
        family, both = (socket.AF_INET6, socket.has_dualstack_ipv6()) if ipv6 else (socket.AF_INET, False)
        return socket.create_server((host, port), family=family, dualstack_ipv6=both)
    except (OSError, OverflowError) as error:
        message = f"{option}: cannot listen on {host} port {port}: {why_not_bound(error)}; allowed: a free port"
        cure = f"{'--web-port' if option == '--web' else '--port'} 0 takes any free one"
        raise ConfigError(f"{message}; {cure}") from error


def app_settings(host: str, port: int) -> str:
    """Return the app's settings, for a server that listens on ``host``."""
    return f"address {' or '.join(reachable_addresses(host))}, port {port}, protocol ROS2"


def access_lines(host: str, port: int, allow: Sequence[Network] | None) -> tuple[str, ...]:
    """Return lines that tell the app's settings, and who can drive now, for a server that listens on ``host``."""
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
    """Return whether only this machine can reach an address."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


# Rules 1 to 4 are in docs/headset.md, "Who drives". A driver that sends no frames is replaced after 37 periods of the
# app's poses, but only by a client of its own host. That is more than three times the time after which the arms pause.
# Without this rule, a headset whose connection was lost without a message could not drive again for seconds.
# A driver without a frame for longer than this is replaced by a new connection of the same headset [s].
QUIET_ALLOWED = 0.5
# A driver without a hand pose for longer than this is replaced by a client that sends poses [s].
POSES_ALLOWED = 5.0
WAIT_ALLOWED = 2.0  # A newcomer that may not drive after this time is refused [s].


@dataclass
class Peer:
    """The known facts about a connected client."""

    peer: str  # Address and port, for people.
    host: str  # Address.
    since: float  # When it connected [s].
    last_frame: float  # When its last whole frame was received [s].
    last_pose: float = -math.inf  # When its last hand pose was received [s].
    registrations: Sequence[Mapping[str, str]] = ({}, {})  # Topics that it publishes, and topics that it listens to.


SomePeer = TypeVar("SomePeer", bound=Peer)


class Admission(Enum):
    """A decision about a client that does not drive."""

    ADMIT = "admit"  # The client drives from now on, instead of the driver if there is one.
    WAIT = "wait"  # The client may stay until more is known about it. None of its data is used.
    REFUSE = "refuse"


def decide(driver: Peer | None, newcomer: Peer, now: float) -> tuple[Admission, str]:
    """Decide about ``newcomer`` at ``now`` [s] by rules 2 to 4.

    Returns:
        The decision, and a reason. The reason says why a refused newcomer, or the ``driver`` that an admitted newcomer
        replaces, has to leave. It is empty if no client has to leave.
    """
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
    """Yield the decisions about newcomers at ``now`` [s]: the newcomer, True if it is admitted, and a reason.

    The reason says why the refused newcomer, or the driver that it replaces, has to leave. Other newcomers go on
    waiting: the newest client of each host, and ``MAX_WAITING`` clients at most. The driver may change between two
    yields, so ``driver`` is a function that returns the present driver.
    """
    newest = {client.host: client for client in waiting}
    still_waiting = 0
    for client in tuple(waiting):
        current = driver()
        verdict, reason = decide(current, client, now)
        if verdict is Admission.ADMIT:
            yield client, True, reason
        elif verdict is Admission.REFUSE or newest[client.host] is not client or still_waiting == MAX_WAITING:
            assert current is not None  # Without a driver, every newcomer is admitted.
            yield client, False, reason or f"{current.peer} is connected"
        else:
            still_waiting += 1


def is_allowed(host: str, networks: Sequence[Network] | None) -> bool:
    """Return whether the address ``host`` lies in one of ``networks``; None allows all addresses (rule 1)."""
    return networks is None or any(ip_address(host) in network for network in networks)
