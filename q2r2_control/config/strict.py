"""The base of all settings."""

from __future__ import annotations

from ipaddress import IPv4Network, IPv6Network, ip_network

from pydantic import BaseModel, ConfigDict


class StrictModel(BaseModel):
    """Settings without unknown keys, change, or numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


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


# Eleven periods of a 75 Hz headset, so that a few lost or late messages on a wireless link do not stop the arms. It is
# short enough that a tool at the default 0.5 m/s moves no more than 75 mm before it begins to brake. It holds for hand
# data, tool poses, targets and acknowledgements of commands.
STREAM_TIMEOUT = 0.15  # [s]
