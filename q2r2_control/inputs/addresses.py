"""Addresses for people: how they are written, which one is this machine's, and what to type into the app."""

from __future__ import annotations

import socket
from collections.abc import Sequence

from q2r2_control.config.strict import Network

EVERY_NETWORK = ("", "0.0.0.0", "::")  # as hosts to listen on
ONLY_THIS_MACHINE = ("127.0.0.1", "::1", "localhost")


def written(host: str, port: int) -> str:
    """Host and port in one text, as ``[::1]:10000`` with IPv6."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def app_settings(host: str, port: int) -> str:
    """What to enter in the app, for a server that listens on ``host``."""
    return f"address {_reachable(host)}, port {port}, protocol ROS2"


def access_lines(host: str, port: int, allow: Sequence[Network] | None) -> tuple[str, ...]:
    """What to enter in the app, and who can drive now, for a server that listens on ``host``."""
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


def _reachable(host: str) -> str:
    """The address by which others reach a server on ``host``.

    Connecting a UDP socket sends nothing; it only picks the way out. The addresses are of ranges that are for
    documentation only.
    """
    if host not in EVERY_NETWORK:
        return host
    ways = [(socket.AF_INET, "192.0.2.1")]
    if host == "::":
        ways.append((socket.AF_INET6, "2001:db8::1"))
    for family, elsewhere in ways:
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.connect((elsewhere, 9))
                return str(probe.getsockname()[0])
        except OSError:
            continue
    return "of this machine (it has no network now)"
