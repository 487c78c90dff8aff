"""What people are told about addresses: what to enter in the app, and who can drive."""

from __future__ import annotations

import socket
from ipaddress import ip_address, ip_network

import pytest

from q2r2_control.inputs.listener import access_lines, app_settings, written


def test_an_ipv6_address_is_written_in_brackets_before_its_port() -> None:
    assert written("127.0.0.1", 10000) == "127.0.0.1:10000"
    assert written("::", 10000) == "[::]:10000"


@pytest.mark.parametrize("host", ["0.0.0.0", "::", ""])
def test_a_server_on_every_network_is_told_to_the_app_by_an_address_that_can_be_typed(host: str) -> None:
    settings = app_settings(host, 10007)
    assert settings.endswith(", port 10007, protocol ROS2")
    address = settings.removeprefix("address ").split(",")[0]
    if not address.startswith("of this machine"):  # which has no network then
        with socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET) as own:
            own.bind((address, 0))
        assert not ip_address(address).is_unspecified


def test_a_server_on_one_address_is_told_by_it() -> None:
    assert app_settings("192.168.1.20", 10000) == "address 192.168.1.20, port 10000, protocol ROS2"


def test_a_server_that_the_network_can_reach_says_who_can_drive_and_how_to_restrict_it() -> None:
    enter, drivers = access_lines("192.168.1.20", 10000, None)
    assert enter == "enter in the app: address 192.168.1.20, port 10000, protocol ROS2"
    assert drivers.startswith("whoever reaches this port can drive the arms")
    assert "headset.allow" in drivers
    _, drivers = access_lines("0.0.0.0", 10000, (ip_network("192.168.1.0/24"), ip_network("10.0.0.7")))
    assert drivers.startswith("only 192.168.1.0/24, 10.0.0.7/32 can drive")


def test_a_server_on_loopback_says_that_the_network_cannot_reach_it() -> None:
    (line,) = access_lines("127.0.0.1", 10000, None)
    assert "this machine only" in line
    assert "--host 0.0.0.0" in line
