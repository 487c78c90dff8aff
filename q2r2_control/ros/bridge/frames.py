"""The tree of frames that /tf and /tf_static tell, as far as one arm needs it: where one frame is in another, now."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

_UNIT = 1e-3  # a quaternion's norm may be off by this


class _Edge:
    """Where a child is in its parent; put together when it is asked for, since most frames of a robot never are."""

    __slots__ = ("_pose", "_transform", "parent", "received")

    def __init__(self, transform: TransformStamped, received: float) -> None:
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
    received: float  # the oldest receipt time of what it was put together from [s]; inf: all of it is static


class FrameTree:
    """Newest transforms by their receipt time; nothing is interpolated, and a history is not kept."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}

    def set(self, transform: TransformStamped, received: float) -> None:
        """Take one transform; numbers that are not finite or no rotation are passed over."""
        if _is_pose(transform):
            self._edges[_name(transform.child_frame_id)] = _Edge(transform, received)

    def find(self, frame: str, within: str) -> Placement | None:
        """Pose of ``frame`` in ``within``; None where no chain of transforms joins them."""
        up = dict(self._upwards(_name(within)))
        for name, placement in self._upwards(_name(frame)):
            if name in up:
                pose = up[name].pose.inverse() * placement.pose
                return Placement(pose, min(up[name].received, placement.received))
        return None

    def _upwards(self, frame: str) -> Iterator[tuple[str, Placement]]:
        """The frame and all above it, with the frame's pose in each; ends even where parents form a ring."""
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
    """Keeps a :class:`FrameTree` up to date for a node."""

    def __init__(self, node: Any) -> None:
        self.tree = FrameTree()
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        node.create_subscription(TFMessage, "/tf", lambda message: self._take(message, node.now), 100)
        node.create_subscription(TFMessage, "/tf_static", lambda message: self._take(message, math.inf), latched)

    def _take(self, message: TFMessage, received: float) -> None:
        for transform in message.transforms:
            self.tree.set(transform, received)


def _name(frame: str) -> str:
    return frame.lstrip("/")


def _is_pose(message: TransformStamped) -> bool:
    p, r = message.transform.translation, message.transform.rotation
    # A sum or a norm with NaN or infinity in it is not finite.
    return math.isfinite(p.x + p.y + p.z) and abs(math.hypot(r.x, r.y, r.z, r.w) - 1.0) <= _UNIT
