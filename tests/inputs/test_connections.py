"""Clients over real TCP are served, wait or are refused. No client disturbs the headset that drives the arms."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import ip_network
from typing import Any

import pytest

from q2r2_control.inputs import connections
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.inputs.session import HeadsetSession
from tests.support.fake_headset import KEEPALIVE, FakeHeadset
from tests.support.headset_server import (
    A_LINE_LATER,
    IDENTITY,
    HandClock,
    collect,
    connect,
    eventually,
    next_topic,
    registered,
    running,
    warnings,
)

HERE, ELSEWHERE = "127.0.0.1", "127.0.0.2"  # The server treats these addresses as two hosts.


@contextmanager
def driving(server: HeadsetServer, source: str = HERE) -> Iterator[FakeHeadset]:
    """Return a headset that has registered and sent a pose."""
    with registered(server, source=source) as headset:
        move(headset, server)
        yield headset


def move(headset: FakeHeadset, server: HeadsetServer, x: float = 0.0) -> None:
    """Send a pose of the left hand, and wait until it has arrived."""
    headset.send(headset.pose("left", (x, 0.0, 0.0), IDENTITY))
    assert collect(server, 1)[-1].position[0] == x


def assert_refused(headset: FakeHeadset, because: bytes) -> None:
    """Assert that the headset gets a handshake and then a refusal that contains ``because``.

    Without a handshake, the app would report a server of another version.
    """
    assert next_topic(headset) == "__handshake"
    assert_ended(headset, because)


def assert_ended(headset: FakeHeadset, because: bytes) -> None:
    """Assert that the server's last message to the app is an error that contains ``because``."""
    last = ("", b"")
    while (frame := headset.read_frame()) is not None:
        last = frame
    assert last[0] == "__error"
    assert because in last[1]


def drives(server: HeadsetServer, headset: FakeHeadset) -> bool:
    return server.statistics.peer == "{}:{}".format(*headset.socket.getsockname())


def test_if_one_headset_drives_other_headsets_are_refused_with_a_reason_and_the_log_names_eight_hosts(
    server: HeadsetServer, clock: HandClock, caplog: pytest.LogCaptureFixture
) -> None:
    hosts = [f"127.0.0.{number}" for number in range(1, 14)]
    with driving(server) as first:
        for source in (HERE, *hosts):
            with FakeHeadset(server.address, source=source) as second:
                second.send(second.registrations())
                assert_refused(second, b"drives")
            clock.advance(A_LINE_LATER)
            move(first, server)
        assert server.connected
        lines = warnings(caplog)  # The log is read before the driver ends its connection, since the end may add a line.
    assert [f"headset {host}:" in line for host, line in zip(hosts, lines, strict=False)] == [True] * 8
    assert "refused: 127.0.0.1:" in lines[0]


def test_if_a_headset_reconnects_after_an_unnoticed_loss_it_drives_at_once_as_a_new_connection(
    server: HeadsetServer, clock: HandClock, caplog: pytest.LogCaptureFixture
) -> None:
    with driving(server) as lost:
        eventually(lambda: server.connected)
        clock.advance(0.6)
        with connect(server) as back:
            back.send(back.registrations())
            eventually(lambda: drives(server, back))
            assert not server.connected, "the loop has to see that a connection was lost"
            assert server.poll(0.0) == []
            back.send(back.pose("left", (5.0, 0.0, 0.0), IDENTITY))
            (sample,) = collect(server, 1)
            eventually(lambda: server.connected)
            assert_ended(lost, b"it came back as 127.0.0.1:")
    assert sample.position[0] == 5.0
    assert server.statistics.connections == 2
    assert not any("refused" in line for line in warnings(caplog))


def keep_alive(headset: FakeHeadset, server: HeadsetServer, clock: HandClock) -> None:
    headset.send(KEEPALIVE)
    eventually(lambda: server._client is not None and server._client.last_frame == clock.now)


def test_a_new_client_that_sends_nothing_is_refused_after_two_seconds(server: HeadsetServer, clock: HandClock) -> None:
    with connect(server) as idle, connect(server, source=ELSEWHERE) as second:
        clock.advance(1.5)
        keep_alive(idle, server, clock)
        clock.advance(0.6)
        assert_ended(second, b"is connected")
        assert drives(server, idle)


def test_at_most_four_hosts_can_wait_and_only_the_newest_connection_of_each_host_waits(server: HeadsetServer) -> None:
    hosts = [f"127.0.0.{number}" for number in range(2, 7)]
    with connect(server):
        waiting = [connect(server, source=host) for host in (*hosts[:4], hosts[0])]
        assert_ended(waiting[0], b"is connected")
        with FakeHeadset(server.address, source=hosts[4]) as fifth:
            assert_refused(fifth, b"is connected")
        waiting[-1].send(waiting[-1].pose("left", (5.0, 0.0, 0.0), IDENTITY))
        eventually(lambda: drives(server, waiting[-1]))
    for headset in waiting:
        headset.close()


def test_data_of_a_waiting_client_reach_no_arm_and_a_fault_of_this_client_ends_only_its_own_connection(
    server: HeadsetServer, clock: HandClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    with driving(server) as first:
        clock.advance(0.6)
        with connect(server) as second:
            second.send(second.pose("left", (5.0, 0.0, 0.0), IDENTITY) + second.command("__ping"))
            assert_ended(second, b"unknown system command")
        with connect(server) as third, monkeypatch.context() as patch:
            patch.setattr(HeadsetSession, "receive", lambda *_: 1 // 0)
            third.send(KEEPALIVE)
            assert_ended(third, b"unexpected fault")
        assert drives(server, first)
        assert server.statistics.topics["q2r_left_hand_pose"].count == 1
        with connect(server) as fourth:
            fourth.send(KEEPALIVE)
            move(first, server, 1.0)  # The quiet headset sends again.
            assert_ended(fourth, b"drives")
        move(first, server, 2.0)


def test_after_the_server_has_stood_still_a_headset_that_sends_does_not_count_as_silent(
    server: HeadsetServer, clock: HandClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    selector = server._connections._selector
    look = selector.select
    frozen: list[bool] = []

    def look_and_stand_still(timeout: float) -> list[Any]:
        """Freeze the process after it has read bytes of the second headset. Meanwhile, the first one's bytes arrive."""
        found = look(timeout)
        if found and not frozen:
            frozen.append(True)
            clock.now += 2.5
            first.send(first.pose("left", (1.0, 0.0, 0.0), IDENTITY))
        return found

    with driving(server) as first:
        monkeypatch.setattr(selector, "select", look_and_stand_still)
        clock.advance(0.0)
        with FakeHeadset(server.address) as second:
            second.send(second.registrations())
            assert_refused(second, b"drives")
        assert frozen
        assert collect(server, 1)[0].position[0] == 1.0
        assert server.statistics.connections == 1
        assert server.statistics.last_disconnect is None


def test_a_flood_of_connections_does_not_keep_another_host_from_being_served(
    server: HeadsetServer, clock: HandClock
) -> None:
    flood = [socket.create_connection(server.address, source_address=(ELSEWHERE, 0)) for _ in range(100)]
    with FakeHeadset(server.address) as headset:
        headset.send(headset.registrations() + headset.pose("left", (1.0, 2.0, 3.0), IDENTITY))
        for _ in range(4):
            clock.advance(0.0501)
        assert not drives(server, headset), "no more than 20 in 0.05 s"

        def has_had_its_turn() -> bool:
            # If the server's thread did not run between two steps above, it accepted only 20 connections in both steps.
            # The headset then has to wait for more steps.
            clock.advance(0.0501)
            time.sleep(0.02)
            return drives(server, headset)

        eventually(has_had_its_turn, "the headset is served when its turn comes")
    assert sum(was_greeted(connection) for connection in flood) == 10, "answers to one host in a second"


def was_greeted(connection: socket.socket) -> bool:
    with connection:
        try:
            return bool(connection.recv(1))
        except ConnectionResetError:
            return False


def test_only_hosts_of_allowed_networks_are_served(clock: HandClock, caplog: pytest.LogCaptureFixture) -> None:
    allow = ip_network("127.0.0.2"), ip_network("10.0.0.0/8")
    with running(HeadsetServer(HERE, 0, clock=clock, allow=allow)) as server:
        for _ in range(3):
            with FakeHeadset(server.address) as headset:
                headset.send(headset.registrations())
                assert_refused(headset, b"127.0.0.1 is not in headset.allow")
        with driving(server, ELSEWHERE) as headset:
            assert drives(server, headset)
        clock.advance(A_LINE_LATER)
    (line,) = warnings(caplog)
    assert "127.0.0.1 is not in headset.allow" in line


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="this machine has no IPv6")
def test_an_allowed_ipv4_network_is_also_allowed_through_an_ipv6_socket(clock: HandClock) -> None:
    with running(HeadsetServer("::", 0, clock=clock, allow=(ip_network("127.0.0.0/8"),))) as server:
        with FakeHeadset(("::1", server.address[1])) as headset:
            assert_refused(headset, b"::1 is not in headset.allow")
        with FakeHeadset((HERE, server.address[1])) as headset:
            headset.read_until("__handshake")
            eventually(lambda: drives(server, headset))


def test_a_headset_that_reads_late_still_gets_all_answers(
    server: HeadsetServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server's own period is set to one hour. Only a socket that becomes writable can therefore wake it."""
    monkeypatch.setattr(connections, "TURN", 3600.0)
    with connect(server) as headset:
        client = server._client
        assert client is not None
        for number in range(50):  # Many topics make the answers long.
            headset.send(headset.command("__publish", topic=f"{number:_>200}", message_name="std_msgs/Empty"))
        asked = 0
        while len(client.session.outgoing) < 30000:  # As soon as two or more answers wait, the socket is full.
            headset.send(headset.command("__topic_list"))
            move(headset, server)
            asked += 1
        for _ in range(asked):
            headset.read_until("__topic_list")
