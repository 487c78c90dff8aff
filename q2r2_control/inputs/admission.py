"""Who may drive: of all clients one, whose hand poses are followed. No sockets, no clocks.

What decides, in this order:

1. A host outside ``headset.allow`` is not served.
2. The place belongs to who sends hand poses. A driver without one for ``POSES_ALLOWED``, keepalives or not, gives way
   to the first other client that sends one.
3. A peer that comes back takes its own place: a connection from the driver's address that registers what the driver
   registered, while no frame has come from the driver for ``QUIET_ALLOWED``. After a silently lost link the old
   connection looks alive for seconds.
4. Everybody else is refused while somebody drives.

Behind one address a second headset could take the place of one that is quiet by rule 3, but never of one that drives:
``QUIET_ALLOWED`` is 37 periods of the app's poses, and three times as long as what pauses the arms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from ipaddress import ip_address
from typing import NamedTuple

from q2r2_control.config.strict import Network

QUIET_ALLOWED = 0.5  # without a frame, against the same peer on a new connection [s]
POSES_ALLOWED = 5.0  # without a hand pose, against a client that sends them [s]
WAIT_ALLOWED = 2.0  # for a newcomer to show what gives it the place [s]


@dataclass
class Peer:
    """What is known of a connected client."""

    peer: str  # address and port, for people
    host: str  # address
    since: float  # when it connected [s]
    last_frame: float  # when its last whole frame was received [s]
    last_pose: float = -math.inf  # when its last hand pose was received [s]
    registrations: Sequence[Mapping[str, str]] = ({}, {})  # topics that it publishes, and that it listens to


class Admission(Enum):
    """What becomes of a newcomer."""

    ADMIT = "admit"  # drives from now on, instead of the driver if there is one
    WAIT = "wait"  # may stay, unheard, until more is known
    REFUSE = "refuse"


class Decision(NamedTuple):
    """A verdict, and why: for ``ADMIT`` why the driver lost its place, for ``REFUSE`` why the newcomer gets none."""

    verdict: Admission
    reason: str = ""


def decide(driver: Peer | None, newcomer: Peer, now: float) -> Decision:
    """What becomes of ``newcomer`` at ``now`` [s], by rules 2 to 4."""
    if driver is None:
        return Decision(Admission.ADMIT)
    if now - driver.last_pose > POSES_ALLOWED:
        if newcomer.last_pose > -math.inf:
            return Decision(Admission.ADMIT, f"no hand pose for {POSES_ALLOWED:g} s, and {newcomer.peer} sends them")
    elif newcomer.host == driver.host and now - driver.last_frame > QUIET_ALLOWED:
        if any(newcomer.registrations) and newcomer.registrations == driver.registrations:
            return Decision(Admission.ADMIT, f"no frame for {QUIET_ALLOWED:g} s, and it came back as {newcomer.peer}")
    else:
        return Decision(Admission.REFUSE, f"{driver.peer} drives")
    if now - newcomer.since > WAIT_ALLOWED:
        return Decision(Admission.REFUSE, f"{driver.peer} is connected")
    return Decision(Admission.WAIT)


def is_allowed(host: str, networks: Sequence[Network] | None) -> bool:
    """Whether the address ``host`` lies in one of ``networks``; None admits all (rule 1)."""
    if networks is None:
        return True
    address = ip_address(host)
    return any(address in network for network in networks)
