"""Where a tool is: told by /tf, or by a topic of poses."""

from __future__ import annotations

import math

import pinocchio as pin
from geometry_msgs.msg import PoseStamped

from q2r2_control.ros.bridge.base_node import STREAM_QOS, BaseNode
from q2r2_control.ros.bridge.frames import FrameTree, Placement
from q2r2_control.ros.bridge.messages import pose_of
from q2r2_control.ros.monitoring.publishers import Publishers


class ToolFrame:
    """The pose of a frame of /tf in the world."""

    def __init__(self, node: BaseNode, tree: FrameTree, frame: str, world: str, timeout: float) -> None:
        self._tree, self._frame, self._world, self._timeout = tree, frame, world, timeout
        self._publishers = Publishers(node, ["/tf"])
        self._publishers.look_steadily()
        self.problem: str | None = None

    def at(self, now: float) -> pin.SE3 | None:
        """The newest pose at ``now`` [s]; None where it is not known, which ``problem`` explains."""
        placement = self._tree.find(self._frame, self._world)
        self.problem = None
        if placement is None:
            self.problem = f"no transform from {self._frame} to {self._world} on /tf"
        elif now - placement.received > self._timeout:
            age = now - placement.received
            self.problem = f"{self._frame} on /tf{self._publishers.source('/tf')} is {age:.2f} s old"
        return None if placement is None or self.problem else placement.pose


class PoseTopic:
    """The pose that a topic tells, in the world; its frame is the message's, through /tf."""

    def __init__(self, node: BaseNode, topic: str, tree: FrameTree, world: str, timeout: float) -> None:
        self._tree, self._world, self._timeout = tree, world, timeout
        self._newest: tuple[PoseStamped, float] | None = None
        self._topic, self._publishers = topic, Publishers(node, [topic])
        self._publishers.look_steadily()
        self.problem: str | None = None
        node.create_subscription(PoseStamped, topic, lambda message: self._take(message, node.now), STREAM_QOS)

    def at(self, now: float) -> pin.SE3 | None:
        """The newest pose at ``now`` [s]; None where it is not known, which ``problem`` explains."""
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
        """Says once that what had come comes no more."""
        if self._newest is None or now - self._newest[1] <= self._timeout:
            return None
        self.at(now)
        self._newest = None
        return self.problem

    def _take(self, message: PoseStamped, now: float) -> None:
        self._newest = message, now
