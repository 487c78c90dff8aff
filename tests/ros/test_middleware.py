"""Nodes over UDP wherever they are to find each other, without leaving what the user has set about it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.ros.launch.middleware import set_up_middleware
from tests.ros.conftest import need_ros
from tests.ros.processes import Processes
from tests.ros.waiting import wait_until

need_ros()

from std_msgs.msg import String

LISTENER = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(String, "/words", lambda message: print(message.data, flush=True), 10)
rclpy.spin(node)
"""


@pytest.mark.parametrize(
    "environment",
    [
        {"FASTRTPS_DEFAULT_PROFILES_FILE": "my.xml"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
        {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
        {"ROS_LOCALHOST_ONLY": "1"},
        {"ROS_STATIC_PEERS": "192.168.1.7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
    ],
)
def test_what_the_user_has_set_stays(environment: dict[str, str]) -> None:
    before = dict(environment)
    set_up_middleware(environment)
    assert environment == before


@pytest.mark.parametrize("ours", [{}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}], ids=["subnet", "localhost"])
def test_a_profile_of_ours_is_set_and_stays(ours: dict[str, str]) -> None:
    set_up_middleware(ours)
    assert Path(ours["FASTRTPS_DEFAULT_PROFILES_FILE"]).is_file()
    # Either says UDP alone: the one by a variable, the other by its profile, which the range has to leave alone.
    assert (
        ours.get("FASTDDS_BUILTIN_TRANSPORTS") == "UDPv4" or ours["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SYSTEM_DEFAULT"
    )
    once = dict(ours)
    set_up_middleware(ours)
    assert ours == once


def shared_memory(process: Any) -> list[str]:
    """What a process shares with others."""
    mapped = Path(f"/proc/{process.pid}/maps")
    if not mapped.exists():
        pytest.skip("needs /proc")
    return [line for line in mapped.read_text().splitlines() if "/dev/shm/fastrtps" in line]


def test_a_node_of_this_machine_alone_hears_others_and_shares_memory_with_none(node: Any, processes: Processes) -> None:
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    set_up_middleware(environment)
    listener = processes.start(sys.executable, "-c", LISTENER, name="listener", **environment)
    publisher = node.create_publisher(String, "/words", 10)
    wait_until(lambda: publisher.publish(String(data="hello")) or "hello" in listener.output, "the listener hears")
    assert not shared_memory(listener)
