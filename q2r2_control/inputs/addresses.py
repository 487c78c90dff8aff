"""Addresses for people: how they are written, which one is this machine's, and what to type into the app."""

from __future__ import annotations

import socket

EVERY_NETWORK = ("", "0.0.0.0", "::")  # as hosts to listen on
ONLY_THIS_MACHINE = ("127.0.0.1", "::1", "localhost")


def written(host: str, port: int) -> str:
    """Host and port in one text, as ``[::1]:10000`` with IPv6."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def app_settings(host: str, port: int) -> str:
    """What to enter in the app, for a server that listens on ``host``."""
    return f"address {_reachable(host)}, port {port}, protocol ROS2"


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
