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


class _Edge(NamedTuple):
    parent: str
    pose: pin.SE3  # of the child in the parent
    received: float  # [s]; inf: static


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
        pose = _pose(transform)
        if pose is not None:
            child, parent = _name(transform.child_frame_id), _name(transform.header.frame_id)
            self._edges[child] = _Edge(parent, pose, received)

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


def _pose(message: TransformStamped) -> pin.SE3 | None:
    position, rotation = message.transform.translation, message.transform.rotation
    translation = np.array([position.x, position.y, position.z])
    quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    norm = float(np.linalg.norm(quaternion))
    if not (np.isfinite(translation).all() and abs(norm - 1.0) <= _UNIT):
        return None
    return pin.SE3(pin.Quaternion(quaternion / norm).toRotationMatrix(), translation)
