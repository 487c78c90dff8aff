"""A computer in several networks names all of its reachable addresses."""

from __future__ import annotations

import socket
import struct
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.inputs import addresses
from q2r2_control.inputs.addresses import NO_NETWORK, reachable_addresses

UP, LOOPBACK, RUNNING = 0x1, 0x8, 0x40
# Flags and address of each network interface: a cable, Wi-Fi, an unused bridge, and an unconfigured cable.
INTERFACES: dict[str, tuple[int, str | None]] = {
    "lo": (UP | LOOPBACK | RUNNING, "127.0.0.1"),
    "eth0": (UP | RUNNING, "192.168.1.5"),
    "wlan0": (UP | RUNNING, "10.0.0.7"),
    "bridge0": (UP, "172.17.0.1"),
    "eth1": (UP | RUNNING, None),
}
IPV6 = """fe800000000000000000000000000001 02 40 20 80 eth0
20010db8000000000000000000000005 02 40 00 80 eth0
20010db8000000000000000000000006 02 40 00 20 eth0
"""


@pytest.fixture
def networks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Make this computer look as if it had these interfaces, with the default route through Wi-Fi."""

    def ioctl(_: object, what: int, request: bytes) -> bytes:
        flags, address = INTERFACES[request[:16].rstrip(b"\0").decode()]
        if what == 0x8913:
            return struct.pack("16sH22x", request[:16], flags)
        if address is None:
            raise OSError("no address")
        return struct.pack("16s4x4s16x", request[:16], socket.inet_aton(address))

    def way_out(family: int, _: str) -> str | None:
        return INTERFACES["wlan0"][1] if family == socket.AF_INET else None

    (tmp_path / "if_inet6").write_text(IPV6)
    fakes: dict[str, Any] = {"fcntl.ioctl": ioctl, "_way_out": way_out, "_IPV6_TABLE": tmp_path / "if_inet6"}
    for name, fake in fakes.items():
        monkeypatch.setattr(f"{addresses.__name__}.{name}", fake)
    monkeypatch.setattr("socket.if_nameindex", lambda: list(enumerate(INTERFACES)))


@pytest.mark.usefixtures("networks")
def test_all_addresses_of_connected_networks_are_named_and_the_default_routes_address_comes_first() -> None:
    assert reachable_addresses("0.0.0.0") == ("10.0.0.7", "192.168.1.5")
    assert reachable_addresses("::") == ("10.0.0.7", "192.168.1.5", "2001:db8::5")
    assert reachable_addresses("192.168.1.5") == ("192.168.1.5",)


def test_on_a_computer_without_a_network_a_text_is_shown_instead_of_an_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.if_nameindex", list)
    monkeypatch.setattr("q2r2_control.inputs.addresses._way_out", lambda *_: None)
    assert reachable_addresses("0.0.0.0") == (NO_NETWORK,)


def test_a_server_can_listen_on_every_address_that_is_named_for_this_computer() -> None:
    for address in reachable_addresses("0.0.0.0"):
        if address != NO_NETWORK:
            socket.create_server((address, 0)).close()
