"""The protocol of one client: its messages and the server's answers, byte for byte, without sockets."""

from __future__ import annotations

import json
import re

import pytest

from q2r2_control.errors import ProtocolError
from q2r2_control.inputs.messages import Dialect, FrameDecoder, WireFrame
from q2r2_control.inputs.session import (
    MAX_COMMAND_BYTES,
    MAX_INCOMPLETE,
    MAX_OUTGOING_BYTES,
    MAX_TOPICS,
    HeadsetSession,
)
from q2r2_control.types import HapticFeedback
from tests.support.fake_headset import pack_inputs, pack_pose, pack_twist

POSITION, IDENTITY = (0.1, 0.2, 0.3), (0.0, 0.0, 0.0, -1.0)
HAPTIC = "q2r_left_hand_haptic_feedback"

every_dialect = pytest.mark.parametrize("dialect", list(Dialect))


def frame(dialect: Dialect, destination: str, payload: bytes = b"") -> WireFrame:
    return WireFrame(destination, payload, terminated=dialect is Dialect.ROS2)


def command(dialect: Dialect, name: str, **parameters: object) -> WireFrame:
    return frame(dialect, name, json.dumps(parameters).encode() + (b"\0" if dialect is Dialect.ROS2 else b""))


def pose(dialect: Dialect, topic: str = "q2r_left_hand_pose") -> WireFrame:
    return frame(dialect, topic, pack_pose(dialect.lower(), POSITION, IDENTITY))


def answers(session: HeadsetSession) -> list[tuple[str, bytes]]:
    """Return and remove the frames that the session wants to send."""
    decoder = FrameDecoder()
    decoder.feed(bytes(session.outgoing))
    session.outgoing.clear()
    found = []
    while (answer := decoder.next_frame()) is not None:
        assert not answer.terminated, "the server writes no NUL"
        found.append((answer.destination, answer.payload))
    return found


@pytest.fixture
def session() -> HeadsetSession:
    """Return a session after its handshake."""
    new = HeadsetSession()
    new.outgoing.clear()
    return new


def test_the_servers_first_message_is_a_handshake_with_a_version_that_the_app_accepts() -> None:
    ((name, payload),) = answers(HeadsetSession())
    handshake = json.loads(payload)
    assert name == "__handshake"
    assert handshake["version"].startswith("v0.7.")
    assert json.loads(handshake["metadata"]) == {"protocol": "ROS2"}


@every_dialect
def test_a_payload_of_the_wrong_dialect_ends_the_session(session: HeadsetSession, dialect: Dialect) -> None:
    other = dialect.other.lower()
    for suffix, wrong in (
        ("pose", pack_pose(other, POSITION, IDENTITY)),
        ("twist", pack_twist(other, POSITION, POSITION)),
        ("inputs", pack_inputs(other, True, False, (0.0,) * 4)),
    ):
        with pytest.raises(ProtocolError, match="dialect"):
            session.receive(frame(dialect, f"q2r_left_hand_{suffix}", wrong))


@every_dialect
def test_a_change_of_dialect_ends_the_session(session: HeadsetSession, dialect: Dialect) -> None:
    session.receive(command(dialect, "__topic_list"))
    assert session.dialect is dialect
    with pytest.raises(ProtocolError, match=f"earlier ones were {dialect}"):
        session.receive(pose(dialect.other))


@every_dialect
def test_a_registration_can_be_removed_and_removing_it_again_is_no_error(
    session: HeadsetSession, dialect: Dialect
) -> None:
    session.receive(command(dialect, "__publish", topic="a", message_name="std_msgs/Empty"))
    session.receive(command(dialect, "__subscribe", topic="b", message_name="std_msgs/Empty"))
    for _ in range(2):
        session.receive(command(dialect, "__remove_publisher", topic="a"))
        session.receive(command(dialect, "__remove_subscriber", topic="/b"))
    assert (session.published, session.subscribed) == ({}, {})


def test_the_topic_list_has_the_type_of_each_topic_as_package_and_name(session: HeadsetSession) -> None:
    for topic in ("dice", "/cup"):
        session.receive(command(Dialect.ROS2, "__publish", topic=topic, message_name="geometry_msgs/Twist"))
    session.receive(command(Dialect.ROS2, "__topic_list"))
    ((name, payload),) = answers(session)
    topics = json.loads(payload)
    assert name == "__topic_list"
    types = dict(zip(topics["topics"], topics["types"], strict=True))
    assert types["/q2r_left_hand_pose"] == "geometry_msgs/PoseStamped"
    assert types["/q2r_right_hand_inputs"] == "quest2ros/OVR2ROSInputs"
    assert types["/" + HAPTIC] == "quest2ros/OVR2ROSHapticFeedback"
    assert types["/dice"] == types["/cup"] == "geometry_msgs/Twist"
    assert all(re.fullmatch(r"/\w+", topic) for topic in types), "as in the ROS graph: one slash before each"
    assert all(re.fullmatch(r"\w+/\w+", kind) for kind in types.values())


@every_dialect
@pytest.mark.parametrize("name", ["__request", "__response"])
def test_a_service_call_with_its_body_is_ignored(session: HeadsetSession, dialect: Dialect, name: str) -> None:
    session.receive(command(dialect, name, srv_id=3))
    assert session.receive(frame(dialect, "any_service", b"\x01\x02")) is None
    assert session.unknown_topics == {}
    assert session.receive(pose(dialect)) is not None


def test_registered_services_are_ignored_and_a_request_is_answered_with_an_error(session: HeadsetSession) -> None:
    for name in ("__ros_service", "__unity_service", "__remove_ros_service", "__remove_unity_service", "__response"):
        session.receive(command(Dialect.ROS2, name, topic="reset", message_name="std_srvs/Empty"))
    session.receive(frame(Dialect.ROS2, "body"))
    session.receive(command(Dialect.ROS2, "__request", srv_id=3))
    ((name, payload),) = answers(session)
    assert name == "__error"
    assert "services" in json.loads(payload)["text"]


@pytest.mark.parametrize("name", ["__ping", "__", "__publish\0"])
def test_an_unknown_system_command_ends_the_session(session: HeadsetSession, name: str) -> None:
    with pytest.raises(ProtocolError, match="unknown system command"):
        session.receive(command(Dialect.ROS1, name))


@pytest.mark.parametrize(
    "payload",
    [
        pytest.param(b"{", id="half an object"),
        pytest.param(b'{"topic":3,"message_name":"a/B"}', id="a topic that is a number"),
        pytest.param(b'{"topic":"\\ud800","message_name":"a/B"}', id="half a surrogate"),
        pytest.param(b'{"topic":"a","message_name":"a/B"}\0\0', id="two NULs"),
        pytest.param(b"\xff\xfe", id="not UTF-8"),
        pytest.param(b"[" * MAX_COMMAND_BYTES, id="nested without end"),
        pytest.param(b'{"topic":' + b"[" * 900 + b"]" * 900 + b"}", id="a nested topic"),
        pytest.param(b"9" * 10000, id="a number of ten thousand digits"),
    ],
)
def test_a_registration_that_cannot_be_read_ends_the_session(session: HeadsetSession, payload: bytes) -> None:
    with pytest.raises(ProtocolError, match=r"__publish|topic name"):
        session.receive(frame(Dialect.ROS1, "__publish", payload))


def test_a_command_may_have_at_most_16_kilobytes(session: HeadsetSession) -> None:
    payload = b'{"topic":"a","message_name":"a/B"}'.ljust(1 << 14)
    session.receive(frame(Dialect.ROS1, "__publish", payload))
    assert session.published == {"a": "a/B"}
    with pytest.raises(ProtocolError, match="16385 bytes, at most 16384 are allowed"):
        session.receive(frame(Dialect.ROS1, "__publish", payload + b" "))


@pytest.mark.parametrize(
    ("name", "given", "missing"),
    [
        ("__publish", {"topic": " ", "message_name": "std_msgs/Empty"}, "topic"),
        ("__subscribe", {"topic": None, "message_name": "std_msgs/Empty"}, "topic"),
        ("__remove_subscriber", {}, "topic"),
        ("__subscribe", {"topic": "dice"}, "message_name of dice"),
        ("__publish", {"topic": "dice", "message_name": ""}, "message_name of dice"),
    ],
)
def test_a_blank_topic_or_type_is_answered_with_an_error_and_the_session_goes_on(
    session: HeadsetSession, name: str, given: dict[str, object], missing: str
) -> None:
    session.receive(command(Dialect.ROS2, name, **given))
    ((answer, payload),) = answers(session)
    assert answer == "__error"
    assert json.loads(payload)["text"] == f"{name}: {missing} is empty; this registration is left out"
    assert (session.published, session.subscribed) == ({}, {})
    assert session.receive(pose(Dialect.ROS2)) is not None


def test_a_flood_of_blank_topics_ends_the_session_even_if_every_answer_is_read(session: HeadsetSession) -> None:
    for _ in range(MAX_INCOMPLETE):
        session.receive(command(Dialect.ROS2, "__publish", topic=""))
        session.outgoing.clear()
    with pytest.raises(ProtocolError, match=f"more than {MAX_INCOMPLETE} registrations without"):
        session.receive(command(Dialect.ROS2, "__publish", topic=""))


def test_data_on_unknown_topics_are_ignored_and_counted_for_a_bounded_number_of_topics(session: HeadsetSession) -> None:
    for index in range(10 * MAX_TOPICS):
        for name in ("/q2r_head_pose", f"topic_{index}"):
            assert session.receive(frame(Dialect.ROS2, name, b"whatever")) is None
    assert session.unknown_topics["q2r_head_pose"] == 10 * MAX_TOPICS
    assert len(session.unknown_topics) == MAX_TOPICS


@pytest.mark.parametrize("name", ["__publish", "__subscribe"])
def test_a_client_that_registers_too_many_topics_is_dropped(session: HeadsetSession, name: str) -> None:
    for index in (0, *range(MAX_TOPICS)):
        session.receive(command(Dialect.ROS2, name, topic=f"topic_{index}", message_name="a/B"))
    with pytest.raises(ProtocolError, match="topics registered"):
        session.receive(command(Dialect.ROS2, name, topic="one_more", message_name="a/B"))


@pytest.mark.parametrize("name", ["q2r left", "//a", "a" * 300, "\n", "é"])
def test_a_destination_that_is_no_valid_topic_name_ends_the_session(session: HeadsetSession, name: str) -> None:
    with pytest.raises(ProtocolError, match="not a topic name"):
        session.receive(frame(Dialect.ROS1, name, b"x"))


def test_a_client_that_leaves_too_many_answers_unread_is_dropped(session: HeadsetSession) -> None:
    question = command(Dialect.ROS2, "__topic_list")
    session.receive(question)
    for _ in range(MAX_OUTGOING_BYTES // len(session.outgoing) - 1):
        session.receive(question)
    with pytest.raises(ProtocolError, match="unread"):
        session.receive(question)


@every_dialect
def test_vibrations_are_sent_in_the_clients_dialect_to_the_topic_name_that_the_client_wrote(
    session: HeadsetSession, dialect: Dialect
) -> None:
    session.receive(command(dialect, "__subscribe", topic="/" + HAPTIC, message_name="a/B"))
    session.queue_haptic(HapticFeedback("left", 0.5, 1.0))
    header = b"\0\1\0\0" if dialect is Dialect.ROS2 else b""
    assert answers(session) == [("/" + HAPTIC, header + bytes.fromhex("0000003f 0000803f"))]


def test_no_vibrations_are_sent_to_a_client_that_has_not_subscribed_or_has_unsubscribed(
    session: HeadsetSession,
) -> None:
    session.queue_haptic(HapticFeedback("left", 0.5, 1.0))
    session.receive(command(Dialect.ROS2, "__subscribe", topic=HAPTIC, message_name="a/B"))
    session.queue_haptic(HapticFeedback("right", 0.5, 1.0))
    session.receive(command(Dialect.ROS2, "__remove_subscriber", topic=HAPTIC))
    session.queue_haptic(HapticFeedback("left", 0.5, 1.0))
    assert answers(session) == []
