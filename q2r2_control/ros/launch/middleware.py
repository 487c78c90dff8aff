"""How Fast DDS, the middleware that ROS 2 Jazzy comes with, is set up where the user has not done it.

Shared memory is left out: a process that is killed while it holds a lock there holds up whoever writes to the same
memory, and all who listen to him, for about a second. And a node that ended without a word is out of the graph after
3 s instead of 20, so that the one in its place does not count as a second one for longer. Each process says that for
itself: those of others stay as long as they say.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path

_PROFILES = Path(__file__).parent / "fastdds"
_PROFILES_FILE, _TRANSPORTS = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"
_FAST_DDS = "rmw_fastrtps"
_RANGE, _PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"


def set_up_middleware(environment: MutableMapping[str, str]) -> None:
    """Add what a process that has not called ``rclpy.init`` yet needs; what the user has set about Fast DDS stays.

    Nothing is added for another middleware: the range that is put into a profile here holds for all of them.
    """
    if not environment.get("RMW_IMPLEMENTATION", _FAST_DDS).startswith(_FAST_DDS):
        return
    # ROS_LOCALHOST_ONLY overrides the range, and brings shared memory whatever a profile says.
    if _PROFILES_FILE in environment or _TRANSPORTS in environment or environment.get("ROS_LOCALHOST_ONLY") == "1":
        return
    if environment.get(_RANGE) != "LOCALHOST":
        environment.update({_TRANSPORTS: "UDPv4", _PROFILES_FILE: str(_PROFILES / "subnet.xml")})
    elif not environment.get(_PEERS):
        # For this range ROS 2 adds shared memory itself, whatever the profile says. For the system's default it adds
        # nothing to it; nor would it static peers, so who names some keeps shared memory.
        environment.update({_RANGE: "SYSTEM_DEFAULT", _PROFILES_FILE: str(_PROFILES / "localhost.xml")})
