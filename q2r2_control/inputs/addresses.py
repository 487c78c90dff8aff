"""Find the network addresses of this computer, for people and for certificates."""

from __future__ import annotations

import fcntl
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

EVERY_NETWORK = ("", "0.0.0.0", "::")  # A server with one of these hosts listens on all networks.
NO_NETWORK = "of this machine (it has no network now)"
# Constants of Linux: ioctl requests about the network interface with a given name, and flags of an interface's state.
_GET_FLAGS, _GET_ADDRESS = 0x8913, 0x8915
_UP, _LOOPBACK, _RUNNING = 0x1, 0x8, 0x40
_IPV6_TABLE = Path("/proc/net/if_inet6")
_GLOBAL_SCOPE, _TENTATIVE_OR_DEPRECATED = 0x00, 0x60


def reachable_addresses(host: str) -> tuple[str, ...]:
    """Return the addresses at which other computers reach a server on ``host``, the default route's address first."""
    if host not in EVERY_NETWORK:
        return (host,)
    found = [address for address in (_way_out(socket.AF_INET, "192.0.2.1"), *_ipv4_addresses()) if address]
    if host == "::":
        found += [address for address in (_way_out(socket.AF_INET6, "2001:db8::1"), *_ipv6_addresses()) if address]
    return tuple(dict.fromkeys(found)) or (NO_NETWORK,)


def _way_out(family: socket.AddressFamily, elsewhere: str) -> str | None:
    """Return this computer's address on the route to ``elsewhere``, or None if there is no route.

    The callers use addresses reserved for documentation (RFC 5737, RFC 3849), which belong to no computer.
    """
    # Connecting a UDP socket sends no data. It only selects the route.
    with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.connect((elsewhere, 9))
        return str(probe.getsockname()[0])
    return None


def _ipv4_addresses() -> Iterator[str]:
    """Yield the IPv4 address of each network interface that is connected, except loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, name in socket.if_nameindex():
            request = struct.pack("16s24x", name.encode())
            with suppress(OSError):  # The request fails if the interface has no address.
                flags = struct.unpack_from("H", fcntl.ioctl(asked, _GET_FLAGS, request), 16)[0]
                if flags & _UP and flags & _RUNNING and not flags & _LOOPBACK:
                    yield socket.inet_ntoa(fcntl.ioctl(asked, _GET_ADDRESS, request)[20:24])


def _ipv6_addresses() -> Iterator[str]:
    """Yield the IPv6 addresses with global scope.

    Link-local addresses are left out, because they need the link's name, which a URL cannot contain.
    """
    with suppress(OSError):
        for line in _IPV6_TABLE.read_text().splitlines():
            digits, _, _, scope, flags, _ = line.split()
            if int(scope, 16) == _GLOBAL_SCOPE and not int(flags, 16) & _TENTATIVE_OR_DEPRECATED:
                yield socket.inet_ntop(socket.AF_INET6, bytes.fromhex(digits))
