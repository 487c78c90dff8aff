"""The topics of a headset's hands: publishers, subscriptions, and a watch for missing data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

from geometry_msgs.msg import PoseStamped, Twist
from quest2ros.msg import OVR2ROSInputs
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from q2r2_control.inputs.messages import HandMessage, HandPose, HandTwist, MessageType
from q2r2_control.inputs.session import HAND_TOPICS
from q2r2_control.recording.ros_topics import RECORDER
from q2r2_control.ros.base_node import STREAM_QOS
from q2r2_control.ros.bridge.messages import (
    hand_inputs,
    hand_pose,
    hand_pose_message,
    hand_twist,
    hand_twist_message,
    inputs_message,
)
from q2r2_control.ros.monitoring.endpoints import Publishers, node_of

# Reliable, so that any subscriber matches: a best-effort publisher does not match reliable subscribers.
PUBLISHED_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
_TYPES = {MessageType.POSE: PoseStamped, MessageType.TWIST: Twist, MessageType.INPUTS: OVR2ROSInputs}
_READERS: dict[MessageType, Callable[[Any], HandMessage]] = {
    MessageType.POSE: hand_pose,
    MessageType.TWIST: hand_twist,
    MessageType.INPUTS: hand_inputs,
}


class HandPublishers:
    """Publishes the messages of a headset on topics of the same names. May be used by any single thread."""

    def __init__(self, node: Node, topics: Iterable[str]) -> None:
        """``topics`` are of :data:`HAND_TOPICS`."""
        self._node = node
        self._publishers = {
            topic: node.create_publisher(_TYPES[HAND_TOPICS[topic].kind], topic, PUBLISHED_QOS) for topic in topics
        }
        self.sent: dict[str, int] = {publisher.topic_name: 0 for publisher in self._publishers.values()}

    def publish(self, topic: str, message: HandMessage, frame: str, t: float) -> None:
        """Publish at once. A pose is in ``frame`` at ``t`` [s]; other messages have neither."""
        publisher = self._publishers[topic]
        self.sent[publisher.topic_name] += 1
        if isinstance(message, HandPose):
            publisher.publish(hand_pose_message(message, frame, t))
        elif isinstance(message, HandTwist):
            publisher.publish(hand_twist_message(message))
        else:
            publisher.publish(inputs_message(message))

    def subscribers(self, hand: str) -> int:
        """How many subscribers the topics of ``hand`` have, a recorder aside."""
        publishers = [publisher for topic, publisher in self._publishers.items() if HAND_TOPICS[topic].hand == hand]
        matched = sum(publisher.get_subscription_count() for publisher in publishers)
        if not matched:
            return 0
        listed = (self._node.get_subscriptions_info_by_topic(publisher.topic_name) for publisher in publishers)
        return min(matched, sum(node_of(info) not in (None, RECORDER) for infos in listed for info in infos))


class HandWatch:
    """Says which data of a hand are missing, and from which node. Both are needed: poses to move, buttons to stop."""

    def __init__(self, node: Node, hand: str, timeout: float) -> None:
        self._hand, self._timeout = hand, timeout
        self._topics = {"pose": f"q2r_{hand}_hand_pose", "button data": f"q2r_{hand}_hand_inputs"}
        self._publishers = Publishers(node, self._topics.values())
        self._publishers.look_steadily()

    def silence(self, now: float, pose_stamp: float, inputs_stamp: float) -> str | None:
        """One line if data are missing; the stamps are the receipt times of the newest, -inf before the first [s]."""
        ages = {"pose": now - pose_stamp, "button data": now - inputs_stamp}
        missing = [what for what, age in ages.items() if age > self._timeout]
        if not missing:
            return None
        what = "data" if len(missing) == len(ages) else missing[0]
        source = self._publishers.source(self._topics[missing[0]])
        age = min(ages[what] for what in missing)
        since = f"for {age:.2f} s" if age < math.inf else "yet"
        return f"no {what} of the {self._hand} hand{source} {since}"


def subscribe_to_hands(node: Node, listener: Callable[[str, HandMessage], None]) -> None:
    """Call ``listener`` with topic and message for every message of either hand."""
    for name, topic in HAND_TOPICS.items():
        read = _READERS[topic.kind]

        def hear(message: Any, name: str = name, read: Callable[[Any], HandMessage] = read) -> None:
            listener(name, read(message))

        node.create_subscription(_TYPES[topic.kind], name, hear, STREAM_QOS)
