"""Where one frame is in another, now: from /tf and /tf_static, or from a topic of poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from tf2_msgs.msg import TFMessage

from q2r2_control.ros.base_node import STREAM_QOS, BaseNode
from q2r2_control.ros.bridge.messages import pose_of
from q2r2_control.ros.monitoring.endpoints import Publishers

# A geometry_msgs/TransformStamped, as rclpy or as rosbags reads it.
Transformed = Any
_TF = "tf2_msgs/msg/TFMessage"
_UNIT = 1e-3  # a quaternion's norm may be off by this


class _Edge:
    """Pose of a child frame in its parent; computed when asked for, since most frames of a robot never are."""

    __slots__ = ("_pose", "_transform", "parent", "received")

    def __init__(self, transform: Transformed, received: float) -> None:
        self.parent, self.received = _name(transform.header.frame_id), received  # [s]; inf: static
        self._transform = transform.transform
        self._pose: pin.SE3 | None = None

    @property
    def pose(self) -> pin.SE3:
        if self._pose is None:
            position, rotation = self._transform.translation, self._transform.rotation
            quaternion = pin.Quaternion(rotation.w, rotation.x, rotation.y, rotation.z).normalized()
            self._pose = pin.SE3(quaternion.toRotationMatrix(), np.array([position.x, position.y, position.z]))
        return self._pose


class Placement(NamedTuple):
    """Where a frame is in another."""

    pose: pin.SE3
    received: float  # the oldest receipt time of the transforms in it [s]; inf: all of them are static


class FrameTree:
    """Newest transforms by their receipt time; nothing is interpolated, and a history is not kept."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def set(self, transform: Transformed, received: float) -> None:
        """Store one transform; one with numbers that are not finite, or without a unit quaternion, is ignored."""
        if _is_pose(transform):
            self._edges[_name(transform.child_frame_id)] = _Edge(transform, received)

    def find(self, frame: str, within: str) -> Placement | None:
        """Pose of ``frame`` in ``within``; None if no chain of transforms connects them."""
        up = dict(self._upwards(_name(within)))
        for name, placement in self._upwards(_name(frame)):
            if name in up:
                pose = up[name].pose.inverse() * placement.pose
                return Placement(pose, min(up[name].received, placement.received))
        return None

    def _upwards(self, frame: str) -> Iterator[tuple[str, Placement]]:
        """The frame and all its ancestors, with the frame's pose in each; ends also if parents form a ring."""
        pose, received = pin.SE3.Identity(), math.inf
        seen: set[str] = set()
        while frame not in seen:
            yield frame, Placement(pose, received)
            seen.add(frame)
            edge = self._edges.get(frame)
            if edge is None:
                return
            pose, received, frame = edge.pose * pose, min(received, edge.received), edge.parent


class FrameListener:
    """Keeps a :class:`FrameTree` up to date for a node.

    A robot's message has dozens of transforms, fifty times a second, of which an arm needs a few. So rosbags reads
    them, which makes no checked message object of each as rclpy does.
    """

    def __init__(self, node: Any) -> None:
        self.tree = FrameTree()
        self._read: Any = get_typestore(Stores.ROS2_JAZZY).deserialize_cdr
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for topic, qos, received in (("/tf", 100, None), ("/tf_static", latched, math.inf)):
            take = partial(self._take, node, received)
            node.create_subscription(TFMessage, topic, take, qos, raw=True)
        self._read(serialize_message(TFMessage()), _TF)  # makes the reader, which takes a while

    def _take(self, node: Any, received: float | None, message: bytes) -> None:
        received = node.now if received is None else received
        try:
            transforms = self._read(message, _TF).transforms
        except (SerdeError, ValueError):
            return  # such as a name that is no UTF-8, which is some other node's fault
        for transform in transforms:
            self.tree.set(transform, received)


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _is_pose(message: Transformed) -> bool:
    p, r = message.transform.translation, message.transform.rotation
    # A sum or a norm with NaN or infinity in it is not finite.
    return math.isfinite(p.x + p.y + p.z) and abs(math.hypot(r.x, r.y, r.z, r.w) - 1.0) <= _UNIT


class ToolFrame:
    """The pose of a frame of /tf in the world."""

    def __init__(self, node: BaseNode, tree: FrameTree, frame: str, world: str, timeout: float) -> None:
        self._tree, self._frame, self._world, self._timeout = tree, frame, world, timeout
        self._publishers = Publishers(node, ["/tf"])
        self._publishers.look_steadily()
        self.problem: str | None = None

    def at(self, now: float) -> pin.SE3 | None:
        """The newest pose at ``now`` [s]; None if it is not known, and then ``problem`` says why."""
        placement = self._tree.find(self._frame, self._world)
        self.problem = None
        if placement is None:
            self.problem = f"no transform from {self._frame} to {self._world} on /tf"
        elif now - placement.received > self._timeout:
            age = now - placement.received
            self.problem = f"{self._frame} on /tf{self._publishers.source('/tf')} is {age:.2f} s old"
        return None if placement is None or self.problem else placement.pose


class PoseTopic:
    """The pose on a topic, in the world; the message's frame is looked up on /tf."""

    def __init__(self, node: BaseNode, topic: str, tree: FrameTree, world: str, timeout: float) -> None:
        self._tree, self._world, self._timeout = tree, world, timeout
        self._newest: tuple[PoseStamped, float] | None = None
        self._topic, self._publishers = topic, Publishers(node, [topic])
        self._publishers.look_steadily()
        self.problem: str | None = None
        node.create_subscription(PoseStamped, topic, lambda message: self._take(message, node.now), STREAM_QOS)

    def at(self, now: float) -> pin.SE3 | None:
        """The newest pose at ``now`` [s]; None if it is not known, and then ``problem`` says why."""
        if self._newest is None:
            self.problem = f"nothing on {self._topic}"
            return None
        message, received = self._newest
        if now - received > self._timeout:
            source = self._publishers.source(self._topic)
            self.problem = f"{self._topic}{source} is silent for {now - received:.2f} s"
            return None
        frame = message.header.frame_id
        placement = self._tree.find(frame, self._world) if frame else Placement(pin.SE3.Identity(), math.inf)
        pose = pose_of(message.pose)
        if pose is None:
            self.problem = f"{self._topic}: not finite or not a rotation"
        elif placement is None:
            self.problem = f"no transform from {frame} of {self._topic} to {self._world} on /tf"
        else:
            self.problem = None
            return placement.pose * pose
        return None

    def take_silence(self, now: float) -> str | None:
        """One line, returned once, if poses came and have stopped coming."""
        if self._newest is None or now - self._newest[1] <= self._timeout:
            return None
        self.at(now)
        self._newest = None
        return self.problem

    def _take(self, message: PoseStamped, now: float) -> None:
        self._newest = message, now
