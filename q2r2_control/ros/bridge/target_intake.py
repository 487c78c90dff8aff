"""Targets in: one topic an arm, each in its own frame, and why those that cannot be used are not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import pinocchio as pin
from geometry_msgs.msg import PoseStamped

from q2r2_control.errors import ConfigError
from q2r2_control.robot.compose import WORLD
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.bridge.base_node import COMMAND_QOS, BaseNode
from q2r2_control.ros.bridge.messages import pose_of
from q2r2_control.ros.monitoring.publishers import Publishers
from q2r2_control.supervision.target_stream import Refusal

_RECENT = 1.0  # refused targets are a warning for this long [s]
# Takes an arm's target in the world frame, or None for one that is no pose, the time [s], and the message's number.
Take = Callable[[str, pin.SE3 | None, float, int | None], Refusal | None]


@dataclass(frozen=True, slots=True)
class Frame:
    """What target poses are given in."""

    name: str
    pose: pin.SE3  # in the world


class TargetIntake:
    """Listens to the targets of all arms. ``changed`` is called when what :meth:`faults` says has changed."""

    def __init__(self, node: BaseNode, robot: Robot, changed: Callable[[], None]) -> None:
        self._node, self._changed = node, changed
        self.frames = {arm: _frame_of(node, robot, arm) for arm in robot.arms}
        self.topics: dict[str, str] = {}
        for arm in robot.arms:
            topic = node.parameter(f"{arm}.target_topic", f"/q2r2/{arm}/target_frame", "targets of this arm")
            if topic in self.topics.values():
                raise ConfigError(f"{arm}.target_topic = {topic!r:.80}: another arm has it; allowed: one of its own")
            self.topics[arm] = topic
        self._publishers = Publishers(node, self.topics.values())
        self._refused: dict[str, tuple[Refusal, float]] = {}  # why an arm's last target was not used, and when [s]
        self.rejected = dict.fromkeys(robot.arms, 0)

    def subscribe(self, take: Take) -> None:
        """Hand each target to ``take``."""
        for arm, topic in self.topics.items():
            self._node.create_subscription(PoseStamped, topic, partial(self._on_target, take, arm), COMMAND_QOS)

    def look(self) -> None:
        """Ask the graph who publishes."""
        self._publishers.look()

    def publishers(self, arm: str) -> str:
        """Nodes that publish an arm's targets."""
        return self._publishers.of(self.topics[arm])

    def source(self, arm: str) -> str:
        """The same for the middle of a sentence."""
        return self._publishers.source(self.topics[arm])

    def faults(self) -> list[str]:
        """A line for each arm whose targets were not used of late."""
        now = self._node.now
        self._refused = {arm: entry for arm, entry in self._refused.items() if now - entry[1] <= _RECENT}
        return [f"target of {arm} not used: {refusal.line}" for arm, (refusal, _) in self._refused.items()]

    def _on_target(self, take: Take, arm: str, message: PoseStamped, info: Mapping[str, int | None]) -> None:
        frame, now = self.frames[arm], self._node.now
        pose = pose_of(message.pose) if message.header.frame_id == frame.name else None
        refusal = take(arm, None if pose is None else frame.pose * pose, now, info["publication_sequence_number"])
        if refusal is not None:
            self._refuse(arm, refusal)
        elif message.header.frame_id != frame.name:
            fault = f"frame_id {message.header.frame_id!r:.40}; allowed: {frame.name!r}"
            self._refuse(arm, Refusal("frame", fault))
        elif pose is None:
            self._refuse(arm, Refusal("pose", "not a finite pose with a unit quaternion"))
        else:
            self._refused.pop(arm, None)

    def _refuse(self, arm: str, refusal: Refusal) -> None:
        """Say why targets are not used: once for each kind of fault, until one is used again or none come any more."""
        self.rejected[arm] += 1
        before = self._refused.get(arm)
        self._refused[arm] = (refusal, self._node.now)
        if before is None or before[0].kind != refusal.kind:
            self._node.get_logger().warning(f"target of {arm} not used: {refusal.line}")
            self._changed()


def _frame_of(node: BaseNode, robot: Robot, arm: str) -> Frame:
    """An arm's frame of targets. Raises :class:`ConfigError` for a link that moves."""
    name = node.parameter(
        f"{arm}.target_frame_id",
        WORLD,
        "frame_id that targets have to have: a link that does not move, or any other name for the cell's world",
    )
    model = robot.model
    if name == WORLD or not model.existFrame(name, pin.FrameType.BODY):
        return Frame(name, pin.SE3.Identity())
    frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
    if frame.parentJoint != 0:
        raise ConfigError(f"{arm}.target_frame_id = {name!r:.60}: that link moves; allowed: one that does not")
    return Frame(name, frame.placement.copy())
