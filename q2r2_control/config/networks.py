"""Addresses and networks as a user writes them."""

from __future__ import annotations

from ipaddress import IPv4Network, IPv6Network, ip_network

Network = IPv4Network | IPv6Network


def network_of(text: str) -> Network:
    """The network ``text``, such as ``192.168.1.0/24`` or ``fd00::/64``; a single address is a network of one.

    Raises :class:`ValueError` that names the text and what is allowed.
    """
    try:
        return ip_network(text)
    except ValueError:
        pass
    try:
        meant = ip_network(text, strict=False)
    except ValueError:
        raise ValueError(f"{text!r:.60} is neither an address nor a network such as 192.168.1.0/24") from None
    raise ValueError(f"{text!r} is an address within a network: write {meant}, or {text.split('/')[0]} alone")
