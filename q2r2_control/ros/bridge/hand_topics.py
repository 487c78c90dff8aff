"""Publishers and subscriptions for the topics of a headset's hands."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache, partial
from typing import Any

from geometry_msgs.msg import PoseStamped, Twist
from quest2ros.msg import OVR2ROSHapticFeedback, OVR2ROSInputs
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosbags.serde import SerdeError

from q2r2_control.events import Reason
from q2r2_control.inputs.messages import HandMessage, HandPose, HandTwist, MessageType
from q2r2_control.inputs.samples import SampleQueue
from q2r2_control.inputs.session import HAND_TOPICS, HAPTIC_TOPICS
from q2r2_control.recording.messages import RECORDER
from q2r2_control.ros.base_node import COMMAND_QOS, STREAM_QOS, BaseNode
from q2r2_control.ros.bridge import messages as convert
from q2r2_control.ros.commanders import OnePublisher
from q2r2_control.ros.monitoring import Publishers, node_of
from q2r2_control.ros.reasons import RosReason
from q2r2_control.types import SIDES, HandInputs, HandSample, HapticFeedback

_DEPTH = 10  # Queue length of publishers. They are reliable, because only reliable publishers match all subscribers.
_KINDS: dict[MessageType, tuple[type, Callable[[Any], HandMessage]]] = {
    MessageType.POSE: (PoseStamped, convert.hand_pose),
    MessageType.TWIST: (Twist, convert.hand_twist),
    MessageType.INPUTS: (OVR2ROSInputs, convert.hand_inputs),
}


@lru_cache(maxsize=32)
def _serialized(inputs: HandInputs) -> bytes:
    """Return the serialized message of a hand's controls. It is cached, because the controls seldom change."""
    return bytes(serialize_message(convert.inputs_message(inputs)))


class HandPublishers:
    """Publishes the messages of a headset on topics of the same names. Only one thread may use it."""

    def __init__(self, node: Node, hands: Iterable[str] = SIDES, kinds: Iterable[MessageType] = tuple(_KINDS)) -> None:
        self._node = node
        wanted = {(hand, kind) for kind in kinds for hand in hands}
        topics = {name: topic for name, topic in HAND_TOPICS.items() if (topic.hand, topic.kind) in wanted}
        self._topics = {(topic.hand, topic.kind): name for name, topic in topics.items()}
        self._publishers = {
            name: node.create_publisher(_KINDS[topic.kind][0], name, _DEPTH) for name, topic in topics.items()
        }
        self._template = lru_cache(maxsize=8)(convert.pose_template)  # The templates of poses, by frame.
        self.sent: dict[str, int] = {publisher.topic_name: 0 for publisher in self._publishers.values()}

    def publish(self, topic: str, message: HandMessage, frame: str, t: float) -> None:
        """Publish at once. A pose is in ``frame`` at ``t`` [s]. Other messages have no frame and no time."""
        publisher = self._publishers[topic]
        self.sent[publisher.topic_name] += 1
        if isinstance(message, HandPose):
            publisher.publish(self._template(frame).fill([*message.position.tolist(), *message.quaternion.tolist()], t))
        elif isinstance(message, HandTwist):
            publisher.publish(convert.hand_twist_message(message))
        else:
            publisher.publish(_serialized(message))

    def publish_sample(
        self, sample: HandSample, frame: str = "", twist: Callable[[], HandTwist | None] = lambda: None
    ) -> None:
        """Publish a sample's messages on topics that have subscribers. A pose with a fault is left out.

        ``twist`` returns the velocity of the hand, and is called only if its topic has subscribers.
        """
        for kind in (MessageType.INPUTS, MessageType.TWIST, MessageType.POSE):
            topic = self._topics.get((sample.hand, kind))
            if topic is None or not self._publishers[topic].get_subscription_count():
                continue
            message: HandMessage | None = sample.inputs
            if kind is MessageType.TWIST:
                message = twist()
            elif kind is MessageType.POSE:
                pose = HandPose(sample.position, sample.quaternion, sample.pose_stamp, frame)
                message = pose if sample.fault is None else None
            if message is not None:
                self.publish(topic, message, frame, sample.pose_stamp)

    def subscribers(self, hand: str) -> int:
        """Return the number of subscribers of the topics of ``hand``. The recorder is not counted."""
        publishers = [publisher for topic, publisher in self._publishers.items() if HAND_TOPICS[topic].hand == hand]
        recorder = f"{self._node.get_namespace().rstrip('/')}{RECORDER}"
        matched = sum(publisher.get_subscription_count() for publisher in publishers)
        listed = (self._node.get_subscriptions_info_by_topic(publisher.topic_name) for publisher in publishers)
        return min(matched, sum(node_of(info) not in (None, recorder) for infos in listed for info in infos))


def subscribe_to_hands(node: Node, listener: Callable[[str, HandMessage], None]) -> None:
    """Call ``listener`` with topic and message for every message of either hand."""
    for name, topic in HAND_TOPICS.items():
        kind, read = _KINDS[topic.kind]

        def hear(message: Any, name: str = name, read: Callable[[Any], HandMessage] = read) -> None:
            listener(name, read(message))

        node.create_subscription(kind, name, hear, STREAM_QOS)


def subscribe_to_haptics(node: Node, vibrate: Callable[[HapticFeedback], None]) -> None:
    for hand, topic in HAPTIC_TOPICS.items():

        def feel(message: OVR2ROSHapticFeedback, hand: str = hand) -> None:
            vibrate(HapticFeedback(hand, message.frequency, message.amplitude))

        node.create_subscription(OVR2ROSHapticFeedback, topic, feel, STREAM_QOS)


class HandIntake:
    """Takes the messages of the hand that drives an arm.

    It subscribes to the topics of a hand when this hand first drives the arm.

    Messages go to ``on_pose`` and ``on_inputs``, which pass them to :meth:`put_pose` and :meth:`put_inputs`. If
    ``on_pose`` is None, poses go to :meth:`put_pose` directly.
    """

    def __init__(
        self,
        node: BaseNode,
        hand: str,
        timeout: float,
        on_pose: Callable[[PoseStamped], None] | None,
        on_inputs: Callable[[OVR2ROSInputs], None],
    ) -> None:
        self._node, self._timeout = node, timeout
        # Without a callback, a pose does not have to be converted into a message.
        take_pose = self.put_pose if on_pose is None else on_pose
        self._callbacks = (
            (PoseStamped, "pose", take_pose, on_pose is None),
            (OVR2ROSInputs, "inputs", on_inputs, False),
        )
        self._publishers: dict[str, Publishers] = {}  # The publishers of each hand.
        self._haptics: dict[str, Any] = {}
        self._one: dict[str, OnePublisher] = {}  # The check for several publishers of each hand.
        self._samples = SampleQueue()
        self._received = -math.inf  # Receipt time of the message that is being processed [s].
        self.follow(hand)

    def follow(self, hand: str) -> None:
        """Take the messages of this hand from now on. Earlier messages do not count."""
        self.hand = hand
        self._samples.take()
        self._pose: tuple[HandPose, float] | None = None
        self._inputs = HandInputs(), -math.inf
        if hand in self._publishers:
            return
        self._publishers[hand] = Publishers(self._node, (_topic(hand, "pose"), _topic(hand, "inputs")))
        self._haptics[hand] = self._node.create_publisher(OVR2ROSHapticFeedback, HAPTIC_TOPICS[hand], COMMAND_QOS)
        topics = []
        for kind, what, callback, raw in self._callbacks:
            take = partial(self._take, hand, callback)
            made = self._node.create_subscription(kind, _topic(hand, what), take, STREAM_QOS, raw=raw)
            topics.append(made.topic_name)
        self._one[hand] = OnePublisher(self._node, topics)

    def put_pose(self, message: PoseStamped | bytes) -> None:
        """Take a pose, serialized or not."""
        try:
            self._pose = convert.hand_pose(message), self._received
        except SerdeError as error:  # The bytes are no valid message. This is a fault of the sender.
            self._node.drop(_topic(self.hand, "pose"), str(error))
            return
        self._put()

    def put_inputs(self, message: OVR2ROSInputs) -> None:
        self._inputs = convert.hand_inputs(message), self._received
        self._put()

    def take(self) -> list[HandSample]:
        return self._samples.take()

    @property
    def stamps(self) -> tuple[float, float]:
        """Return the receipt times of the newest pose and of the newest inputs [s]; -inf if none has come yet."""
        return -math.inf if self._pose is None else self._pose[1], self._inputs[1]

    def silence(self, now: float) -> Reason | None:
        """Return a reason if poses, which are needed to move, or buttons, which are needed to stop, are missing."""
        ages = {what: now - stamp for what, stamp in zip(("pose", "inputs"), self.stamps, strict=True)}
        missing = {what: age for what, age in ages.items() if age > self._timeout}
        if not missing:
            return None
        first = next(iter(missing))
        what = "data" if len(missing) == len(ages) else "pose" if first == "pose" else "button data"
        source = self._publishers[self.hand].source(_topic(self.hand, first))
        if (age := min(missing.values())) == math.inf:
            return Reason.of(RosReason.HAND_UNKNOWN, data=what, hand=self.hand, source=source)
        return Reason.of(RosReason.HAND_SILENT, data=what, hand=self.hand, source=source, age=age)

    @property
    def conflict(self) -> Reason | None:
        """Return a reason if the hand has more than one publisher, because the arm would follow them in turns."""
        return self._one[self.hand].conflict()

    def feel(self, pulse: HapticFeedback) -> None:
        feedback = OVR2ROSHapticFeedback(frequency=pulse.frequency, amplitude=pulse.amplitude)
        self._haptics[pulse.hand].publish(feedback)

    def _take(self, hand: str, callback: Callable[[Any], None], message: Any, info: Mapping[str, Any]) -> None:
        if hand == self.hand:
            self._received = self._node.now - convert.age(info)
            callback(message)

    def _put(self) -> None:
        if self._pose is not None:
            pose, stamp = self._pose
            self._samples.put(HandSample(self.hand, pose.position, pose.quaternion, stamp, *self._inputs))


def _topic(hand: str, what: str) -> str:
    return f"q2r_{hand}_hand_{what}"
