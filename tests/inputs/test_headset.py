"""The headset server over real TCP sends messages to the app, drops faulty clients, and never lets the loop wait."""

from __future__ import annotations

import math
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from unittest.mock import MagicMock

import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import InputError
from q2r2_control.inputs.base import make_input
from q2r2_control.inputs.connections import MAX_FRAMES_PER_SECOND
from q2r2_control.inputs.headset import HeadsetServer
from q2r2_control.inputs.messages import Dialect, HandPose
from q2r2_control.inputs.samples import Watched
from q2r2_control.inputs.session import HeadsetSession
from q2r2_control.types import HandFault, HapticFeedback
from tests.support.fake_headset import DIALECTS, KEEPALIVE, FakeHeadset, pack_pose
from tests.support.headset_server import (
    A_LINE_LATER,
    IDENTITY,
    HandClock,
    assert_serves,
    collect,
    connect,
    eventually,
    next_topic,
    registered,
    running,
    wait_until_dropped,
    warnings,
)

HAPTIC = "q2r_left_hand_haptic_feedback"

every_dialect = pytest.mark.parametrize("dialect", DIALECTS)


@every_dialect
@pytest.mark.parametrize("slash", [False, True], ids=["bare names", "leading slash"])
def test_a_headset_gets_a_handshake_and_answers_and_the_poses_of_its_hands_arrive(
    server: HeadsetServer, dialect: str, slash: bool
) -> None:
    with FakeHeadset(server.address, dialect, slash) as headset:
        assert next_topic(headset) == "__handshake"
        headset.send(headset.registrations())
        headset.read_until("__topic_list")
        headset.send(headset.inputs("left", lower=True, analog=(0.5, -0.5, 0.25, 1.0)))
        headset.send(headset.pose("left", (0.1, 0.2, 0.3), IDENTITY))
        headset.send(headset.twist("left", (1.0, 2.0, 3.0), (4.0, 5.0, 6.0)))
        headset.send(headset.pose("right", (0.4, 0.5, 0.6), (0.0, 0.6, 0.8, 0.0), frame_id="room"))
        left, right = collect(server, 2)
        assert server.connected
    assert (left.hand, left.position.tolist(), left.quaternion.tolist()) == ("left", [0.1, 0.2, 0.3], list(IDENTITY))
    assert left.inputs.button_lower
    assert not left.inputs.button_upper
    assert (left.inputs.thumb_stick_vertical, left.inputs.press_middle) == (-0.5, 1.0)
    assert (right.hand, right.position.tolist()) == ("right", [0.4, 0.5, 0.6])


def test_a_sample_has_the_time_of_receipt_and_the_statistics_keep_the_headsets_own_stamp(
    server: HeadsetServer, clock: HandClock
) -> None:
    with connect(server) as headset:
        headset.send(headset.pose("left", (0.0, 0.0, 0.0), IDENTITY, frame_id="headset"))
        (first,) = collect(server, 1)
        clock.now += 0.25
        headset.send(headset.inputs("left", lower=True))
        (second,) = collect(server, 1)
        last = server.statistics.topics["q2r_left_hand_pose"].last
    assert (first.pose_stamp, second.pose_stamp, second.inputs_stamp) == (100.0, 100.0, 100.25)
    assert isinstance(last, HandPose)
    assert (last.stamp, last.frame_id) == (12.0000005, "headset")


def test_a_server_with_nothing_to_send_sends_a_keepalive_and_the_socket_does_not_delay_small_messages(
    server: HeadsetServer, clock: HandClock
) -> None:
    with connect(server) as headset:
        assert server._client is not None
        assert server._client.socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        clock.now += 1.1
        assert headset.socket.recv(100) == KEEPALIVE


@every_dialect
def test_vibrations_arrive_as_two_floats_that_are_clipped_to_the_range_from_0_to_1(
    server: HeadsetServer, dialect: str
) -> None:
    with registered(server, dialect) as headset:
        server.send_haptic(HapticFeedback("left", frequency=0.5, amplitude=7.0))
        payload = headset.read_until(HAPTIC)
        assert len(payload) == (8 if dialect == "ros1" else 12)
        assert struct.unpack("<2f", payload[-8:]) == (0.5, 1.0)
        for value in (math.nan, -math.inf):  # Vibrations with these values are not sent.
            server.send_haptic(HapticFeedback("left", value, 1.0))
            server.send_haptic(HapticFeedback("left", 1.0, value))
        server.send_haptic(HapticFeedback("right", 1.0, 1.0))
        assert next_topic(headset) == "q2r_right_hand_haptic_feedback"
        server.send_haptic(HapticFeedback("left", frequency=-1.0, amplitude=0.25))
        assert struct.unpack("<2f", headset.read_until(HAPTIC)[-8:]) == (0.0, 0.25)


def test_vibrations_without_a_headset_or_a_subscription_are_dropped(server: HeadsetServer) -> None:
    server.send_haptic(HapticFeedback("left", 1.0, 1.0))
    with connect(server) as headset:
        server.send_haptic(HapticFeedback("left", 1.0, 1.0))
        headset.send(headset.command("__topic_list"))
        assert next_topic(headset) == "__topic_list"
    server.close()
    server.send_haptic(HapticFeedback("left", 1.0, 1.0))


def test_a_headset_that_does_not_read_gets_only_the_newest_vibration_and_the_next_headset_gets_no_old_vibration(
    server: HeadsetServer,
) -> None:
    with registered(server) as headset:
        assert server._client is not None
        network = server._client.socket = MagicMock(wraps=server._client.socket)
        network.send.side_effect = BlockingIOError  # The network behaves as if the other end did not read.
        for step in range(51):
            server.send_haptic(HapticFeedback("left", step / 50.0, 1.0))
            time.sleep(0.001)  # The server's thread runs meanwhile. A queue without a bound would grow.
        headset.send(headset.pose("left", (1.0, 2.0, 3.0), IDENTITY))
        assert collect(server, 1)[0].position.tolist() == [1.0, 2.0, 3.0]
        network.send.side_effect = None
        received = [struct.unpack("<2f", headset.read_until(HAPTIC)[-8:])[0] for _ in range(2)]
        assert received[0] < 1.0, "what was on its way"
        assert received[1] == 1.0, "the newest"
        network.send.side_effect = BlockingIOError
        for _ in range(10):
            server.send_haptic(HapticFeedback("left", 0.5, 0.5))
            time.sleep(0.001)
        headset.close()
        eventually(lambda: server.statistics.peer is None)
    with registered(server) as second:
        server.send_haptic(HapticFeedback("right", 1.0, 1.0))
        assert next_topic(second) == "q2r_right_hand_haptic_feedback"


def test_a_listener_gets_every_message_in_order_and_poll_returns_nothing_for_a_server_with_a_listener(
    clock: HandClock,
) -> None:
    heard: list[Watched] = []
    with running(HeadsetServer(port=0, clock=clock, listener=heard.append)) as server, connect(server) as headset:
        for index in range(100):
            headset.send(headset.pose("left", (float(index), 0.0, 0.0), IDENTITY))
            headset.send(headset.twist("left", (float(index), 0.0, 0.0), (0.0, 0.0, 0.0)))
            headset.send(headset.inputs("right", lower=index % 2 == 0))
        eventually(lambda: len(heard) == 300)
        topics = ("q2r_left_hand_pose", "q2r_left_hand_twist", "q2r_right_hand_inputs")
        assert [watched.reception.topic for watched in heard] == [*topics] * 100
        poses = [watched.reception.message for watched in heard[::3]]
        assert [pose.position[0] for pose in poses if isinstance(pose, HandPose)] == list(range(100))
        assert server.poll(0.0) == []


def test_a_frozen_pose_has_a_fault_and_after_a_new_connection_the_same_pose_has_no_fault(
    server: HeadsetServer, clock: HandClock
) -> None:
    for expected in ([None, None, HandFault.FROZEN], [None, None]):
        with connect(server) as headset:
            assert faults(server, headset, len(expected), lambda: clock.advance(0.3)) == expected
        eventually(lambda: server.statistics.peer is None)


def faults(server: HeadsetServer, headset: FakeHeadset, count: int, wait: Callable[[], None]) -> list[HandFault | None]:
    """Send the same pose ``count`` times, and ``wait`` after each time. Return the faults of the samples."""
    found = []
    for _ in range(count):
        headset.send(headset.pose("left", (1.0, 2.0, 3.0), IDENTITY))
        found += [sample.fault for sample in collect(server, 1)]
        wait()
    return found


def test_the_server_uses_the_headset_settings_of_the_cell() -> None:
    cell = load_config("config/dual_iiwa7.yaml")
    quick = cell.headset.model_copy(update={"port": 0, "frozen_time": 0.1})
    server = make_input("headset", cell.model_copy(update={"headset": quick}))
    assert isinstance(server, HeadsetServer)
    with running(server), connect(server) as headset:
        assert faults(server, headset, 2, lambda: time.sleep(0.15)) == [None, HandFault.FROZEN]


def test_no_data_of_a_lost_connection_are_in_the_samples_of_the_next_connection(server: HeadsetServer) -> None:
    with connect(server) as first:
        first.send(first.inputs("left", lower=True) + first.pose("left", (1.0, 2.0, 3.0), IDENTITY))
        collect(server, 1)
        first.send(first.pose("left", (5.0, 2.0, 3.0), IDENTITY))
        eventually(lambda: server.statistics.topics["q2r_left_hand_pose"].count == 2)
    eventually(lambda: server.statistics.peer is None)
    assert not server.connected
    with connect(server) as second:
        second.send(second.inputs("right") + second.pose("left", (0.0, 0.0, 0.0), IDENTITY))
        (sample,) = collect(server, 1)
        assert sample.position.tolist() == [0.0, 0.0, 0.0]
        assert not sample.inputs.button_lower
        assert sample.inputs_stamp == float("-inf")
        assert server.statistics.subscribed == ()


def forged(headset: FakeHeadset) -> bytes:
    """Return a pose in the dialect that this headset does not use."""
    other = "ros1" if headset.dialect == "ros2" else "ros2"
    return headset.frame("q2r_left_hand_pose", pack_pose(other, (0, 0, 0), IDENTITY))


def cut_off(headset: FakeHeadset, clock: HandClock) -> None:
    headset.send(forged(headset)[:30])
    headset.close()


# There is one case of each kind of fault. Other tests check more cases of wrong frames and sessions.
FAULTS: dict[str, tuple[Callable[[FakeHeadset, HandClock], object], str]] = {
    "silence": (lambda _, clock: clock.advance(2.1 - A_LINE_LATER), "no frame for 2 s"),
    "oversized frame": (lambda one, _: one.send(struct.pack("<I1sI", 1, b"a", 1 << 20)), "at most 1048576"),
    "unknown system command": (lambda one, _: one.send(one.command("__ping")), "unknown system command"),
    "log forgery": (lambda one, _: one.send(one.frame("a\nINFO all is well", b"")), "not a topic name"),
    "pose of the other dialect": (lambda one, _: one.send(forged(one)), "dialect"),
    "flood of frames": (lambda one, _: one.send(KEEPALIVE * (MAX_FRAMES_PER_SECOND + 100)), "frames in a second"),
    "cut off inside a frame": (cut_off, "ended inside a frame"),
    "reset": (lambda one, _: one.reset(), "connection lost: "),
}


@pytest.mark.parametrize("fault", list(FAULTS))
def test_a_client_with_a_fault_is_dropped_with_one_line_in_the_log_and_the_next_client_is_served(
    server: HeadsetServer, clock: HandClock, fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    break_down, reason = FAULTS[fault]
    with connect(server) as headset:
        headset.send(headset.registrations() + headset.pose("left", (1.0, 2.0, 3.0), IDENTITY))
        collect(server, 1)
        headset.read_until("__topic_list")
        clock.now += A_LINE_LATER
        break_down(headset, clock)
        eventually(lambda: not server.connected)
        if headset.socket.fileno() != -1:  # The connection is still open.
            last = deque(iter(headset.read_frame, None), maxlen=1).pop()
            assert last is not None
            assert last[0] == "__error"
            assert reason.encode() in last[1], "the operator's app is told why"
    (line,) = warnings(caplog)
    assert reason in line
    assert "\n" not in line
    assert reason in str(server.statistics.last_disconnect)
    clock.now += A_LINE_LATER
    assert_serves(server)
    assert len(warnings(caplog)) == 1


def test_a_connection_that_ends_between_frames_is_not_a_fault(
    server: HeadsetServer, caplog: pytest.LogCaptureFixture
) -> None:
    assert_serves(server)
    assert warnings(caplog) == []
    assert server.statistics.last_disconnect == "closed by the headset"


def test_an_unexpected_exception_is_logged_and_ends_only_the_connection_in_which_it_was_raised(
    server: HeadsetServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with monkeypatch.context() as patch, connect(server) as headset:
        patch.setattr(HeadsetSession, "receive", lambda *_: 1 // 0)
        headset.send(KEEPALIVE)
        wait_until_dropped(server, headset)
    assert any(record.exc_info and "by zero" in str(record.exc_info[1]) for record in caplog.records)
    assert_serves(server)


def test_poll_and_send_haptic_do_not_wait_for_the_locks_of_other_threads(server: HeadsetServer) -> None:
    with connect(server) as headset, server._session_lock, server._stream._lock:
        headset.send(headset.pose("left", (1.0, 2.0, 3.0), IDENTITY))

        def tick() -> None:
            server.poll(0.0)
            server.send_haptic(HapticFeedback("left", 1.0, 1.0))

        asked = threading.Thread(target=tick)
        asked.start()
        asked.join(5.0)
        assert not asked.is_alive()


def test_the_error_names_an_address_that_cannot_be_bound_and_the_default_address_is_loopback(
    server: HeadsetServer,
) -> None:
    assert HeadsetServer().address == ("127.0.0.1", 10000)
    for host, port in (server.address, ("no such host", 0), ("127.0.0.1", 70000)):
        with pytest.raises(InputError, match=f"cannot listen on {host}:{port}"):
            HeadsetServer(host, port).start()
    with pytest.raises(InputError, match="already"):
        server.start()


def test_close_frees_the_port_and_ends_the_thread_and_may_be_called_twice(server: HeadsetServer) -> None:
    with connect(server) as headset:
        server.close()
        server.close()
        assert not server.connected
        assert server.poll(0.0) == []
        while headset.read_frame() is not None:
            pass
    with running(HeadsetServer(port=server.address[1])) as again:
        assert_serves(again)
    assert "headset" not in {thread.name for thread in threading.enumerate()}


def test_statistics_show_peer_dialect_counts_rates_and_last_values(server: HeadsetServer, clock: HandClock) -> None:
    assert (server.statistics.peer, server.statistics.topics) == (None, {})
    with connect(server, "ros1") as headset:
        headset.send(headset.registrations() + headset.frame("q2r_head_pose", b"?"))
        for index in range(90):
            clock.now += 1.0 / 75.0
            headset.send(headset.pose("left", (float(index), 0.0, 0.0), IDENTITY))
            collect(server, 1)
        clock.now += 0.2
        statistics = server.statistics
        assert statistics.peer == "{}:{}".format(*headset.socket.getsockname())
    pose = statistics.topics["q2r_left_hand_pose"]
    assert isinstance(pose.last, HandPose)
    assert (statistics.dialect, pose.count, pose.last.position[0]) == (Dialect.ROS1, 90, 89.0)
    # The rate is measured over one second. In its first 0.8 s poses came at 75 Hz, and in its last 0.2 s none came.
    assert pose.rate == pytest.approx(60.0, abs=1.0)
    assert pose.age == pytest.approx(0.2)
    assert statistics.unknown_topics == {"q2r_head_pose": 1}
    assert set(statistics.subscribed) == {HAPTIC, "q2r_right_hand_haptic_feedback"}
    assert "q2r_left_hand_twist" in statistics.published
    assert (statistics.connections, statistics.last_disconnect) == (1, None)
