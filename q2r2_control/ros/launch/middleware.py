"""Set up Fast DDS, the middleware of ROS 2 Jazzy, for this process, unless the user has done so.

Shared memory is switched off. If a process is killed while it holds a lock there, all writers to the same memory and
all subscribers of these writers are delayed for about a second. A node that died leaves the graph after 3 s instead of
20 s. If the node is started again, it therefore counts as a second publisher for 3 s at most.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path

_PROFILES = Path(__file__).parent / "fastdds"
_PROFILES_FILE, _TRANSPORTS = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"
_FAST_DDS = "rmw_fastrtps"
_RANGE, _PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"


def set_up_middleware(environment: MutableMapping[str, str]) -> None:
    """Add the variables for Fast DDS before ``rclpy.init``, unless the user has set these or another middleware."""
    if not environment.get("RMW_IMPLEMENTATION", _FAST_DDS).startswith(_FAST_DDS):
        return
    # ROS_LOCALHOST_ONLY overrides the discovery range. With this variable, shared memory is used even if a profile
    # disables shared memory.
    if _PROFILES_FILE in environment or _TRANSPORTS in environment or environment.get("ROS_LOCALHOST_ONLY") == "1":
        return
    if environment.get(_RANGE) != "LOCALHOST":
        environment.update({_TRANSPORTS: "UDPv4", _PROFILES_FILE: str(_PROFILES / "subnet.xml")})
    elif not environment.get(_PEERS):
        # For LOCALHOST, ROS 2 adds shared memory even if a profile disables it. For SYSTEM_DEFAULT, it adds neither
        # shared memory nor static peers. If the user has set static peers, the range therefore stays LOCALHOST, with
        # shared memory.
        environment.update({_RANGE: "SYSTEM_DEFAULT", _PROFILES_FILE: str(_PROFILES / "localhost.xml")})
