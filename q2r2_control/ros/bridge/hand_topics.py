"""The topics of a headset's hands: publishers and subscriptions."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from geometry_msgs.msg import PoseStamped, Twist
from quest2ros.msg import OVR2ROSHapticFeedback, OVR2ROSInputs
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from q2r2_control.inputs.messages import HandMessage, HandPose, HandTwist, MessageType
from q2r2_control.inputs.session import HAND_TOPICS, HAPTIC_TOPICS
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
from q2r2_control.ros.monitoring.endpoints import node_of
from q2r2_control.types import SIDES, HandSample, HapticFeedback

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

    def __init__(self, node: Node, hands: Iterable[str] = SIDES, kinds: Iterable[MessageType] = tuple(_TYPES)) -> None:
        self._node = node
        wanted = {(hand, kind) for kind in kinds for hand in hands}
        topics = {name: topic for name, topic in HAND_TOPICS.items() if (topic.hand, topic.kind) in wanted}
        self._topics = {(topic.hand, topic.kind): name for name, topic in topics.items()}
        self._publishers = {
            name: node.create_publisher(_TYPES[topic.kind], name, PUBLISHED_QOS) for name, topic in topics.items()
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

    def publish_sample(self, sample: HandSample, frame: str = "", twist: HandTwist | None = None) -> None:
        """Publish a sample's messages on those topics that there are; a pose with a fault is left out."""
        messages: dict[MessageType, HandMessage | None] = {MessageType.INPUTS: sample.inputs, MessageType.TWIST: twist}
        if sample.fault is None:
            messages[MessageType.POSE] = HandPose(sample.position, sample.quaternion, sample.pose_stamp, frame)
        for kind, message in messages.items():
            topic = self._topics.get((sample.hand, kind))
            if topic is not None and message is not None:
                self.publish(topic, message, frame, sample.pose_stamp)

    def subscribers(self, hand: str) -> int:
        """How many subscribers the topics of ``hand`` have, a recorder aside."""
        publishers = [publisher for topic, publisher in self._publishers.items() if HAND_TOPICS[topic].hand == hand]
        matched = sum(publisher.get_subscription_count() for publisher in publishers)
        if not matched:
            return 0
        listed = (self._node.get_subscriptions_info_by_topic(publisher.topic_name) for publisher in publishers)
        return min(matched, sum(node_of(info) not in (None, RECORDER) for infos in listed for info in infos))


def subscribe_to_hands(node: Node, listener: Callable[[str, HandMessage], None]) -> None:
    """Call ``listener`` with topic and message for every message of either hand."""
    for name, topic in HAND_TOPICS.items():
        read = _READERS[topic.kind]

        def hear(message: Any, name: str = name, read: Callable[[Any], HandMessage] = read) -> None:
            listener(name, read(message))

        node.create_subscription(_TYPES[topic.kind], name, hear, STREAM_QOS)


def subscribe_to_haptics(node: Node, vibrate: Callable[[HapticFeedback], None]) -> None:
    """Call ``vibrate`` with what either hand is to feel."""
    for hand, topic in HAPTIC_TOPICS.items():

        def feel(message: OVR2ROSHapticFeedback, hand: str = hand) -> None:
            vibrate(HapticFeedback(hand, message.frequency, message.amplitude))

        node.create_subscription(OVR2ROSHapticFeedback, topic, feel, STREAM_QOS)
