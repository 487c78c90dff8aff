"""What an arm's node has in common with that of the other arm: stops, swapped hands, and two arms that carry.

What either says travels with the heartbeats of :mod:`arm_link`. While two arms carry, each node also publishes poses on
``/<robot>/<arm>/carry``, one at each tick: the node that leads the other tool's target, the other one where its
controller has its tool. A pose is a JSON object in a String: ``session``, which both have agreed on; ``stamp`` of the
sender's tick [ns]; ``frame``; ``pose``, position and quaternion x y z w; ``reference``, the stamp of the controller's
message that the pose is of [ns], or null. What is not usable, late, or of another session or frame is not taken.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError
from std_msgs.msg import String

from q2r2_control.config.timeouts import STREAM_TIMEOUT
from q2r2_control.ros.base_node import COMMAND_QOS, SENT_COMMAND_QOS, BaseNode
from q2r2_control.ros.bridge.messages import nanoseconds, pose_numbers, pose_of_numbers, time_message
from q2r2_control.ros.bridge.parameters import ArmParameters
from q2r2_control.ros.monitoring.arm_link import ArmLink, CarryTold, PoseNumbers
from q2r2_control.ros.monitoring.endpoints import PublisherCount, publish_in_time
from q2r2_control.supervision.delay_watch import DelayWatch
from q2r2_control.teleop.arm_states import AT_REST
from q2r2_control.teleop.remote_arm import CarriedPose, CarryWord, RemoteArm
from q2r2_control.teleop.teleop import Teleop


class _CarriedPose(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    session: str
    stamp: int
    frame: str
    pose: PoseNumbers
    reference: int | None = None


class ArmPair:
    """One arm's node beside the other one. Of each tick :meth:`hear` is the begin, and :meth:`tell` the end."""

    def __init__(self, node: BaseNode, link: ArmLink, arm: str, values: ArmParameters, teleop: Teleop) -> None:
        self._node, self._link, self._arm, self._teleop = node, link, arm, teleop
        self._frame = values.world_frame
        self._remote = RemoteArm(link.other, values.teleop, link.run, values.link_timeout)
        teleop.pair_with(self._remote)
        self._delays = DelayWatch(STREAM_TIMEOUT)
        self._topic = link.topic_of(link.other, "carry")
        self._senders = PublisherCount(node, self._topic)
        self._publisher = node.create_publisher(String, link.topic_of(arm, "carry"), SENT_COMMAND_QOS)
        self._sent = 0
        node.create_subscription(String, self._topic, self._on_pose, COMMAND_QOS)

    @property
    def asked(self) -> bool:
        """Whether this arm is asked to be carried, for which its hand need not be there."""
        return self._remote.asked

    @property
    def sent(self) -> dict[str, int]:
        """How many poses went out to the other node, by topic."""
        return {self._publisher.topic_name: self._sent}

    def hear(self, reference: int | None) -> None:
        """What the other node says; ``reference``: stamp of the controller's reference in this tick [ns], or None."""
        remote, told = self._remote, self._link.carry
        remote.other_run, remote.reference = self._link.other_run, reference
        remote.heard = None if told is None else _word(told)
        senders = self._senders.count
        remote.problem = None
        if told is not None and told.leads and told.frame != self._frame:
            frames = f"{self._frame!r:.40} of the {self._arm} arm and {told.frame!r:.40} of the {remote.arm} one"
            remote.problem = f"world_frame_id is {frames}: set both alike"
        elif senders > 1:
            remote.problem = (
                f"{senders} publishers of {self._topic}, allowed is one (a killed one counts for some seconds)"
            )

    def agree(self, now: float) -> None:
        """Go by what the other arm's hand has asked for, for both."""
        link, teleop = self._link, self._teleop
        if link.stopped != teleop.stopped:
            teleop.set_stopped(link.stopped, now, f"the {link.other} arm's operator")
        teleop.set_swapped(link.swapped, now)
        teleop.allow_swapping(link.unswappable)

    def send(self, now: float, decided: float) -> None:
        """Publish the pose that is for the other node in the tick at ``now`` [s]; see :func:`publish_in_time`."""
        said, pose = self._remote.said, self._remote.sends
        if said is None or pose is None:
            return
        message = _CarriedPose(
            session=said.session,
            stamp=nanoseconds(time_message(now)),
            frame=self._frame,
            pose=pose_numbers(pose),
            reference=self._remote.reference,
        )
        self._sent += publish_in_time(self._publisher, String(data=message.model_dump_json()), decided)

    def tell(self) -> None:
        """Tell the other node what this arm does, and what its hand has asked for, for both."""
        link, teleop, said = self._link, self._teleop, self._remote.said
        link.set_stopped(teleop.stopped)
        link.set_swapped(teleop.swapped)
        link.set_aligning(teleop.aligning)
        link.at_rest = teleop.states[self._arm] in AT_REST
        if said is not None:
            tool = None if said.tool is None else pose_numbers(said.tool)
            told = CarryTold(
                session=said.session, to=said.to, leads=said.leads, frame=self._frame, tool=tool, refusal=said.refusal
            )
            link.say_carry(told)

    def _on_pose(self, message: String, info: Mapping[str, Any]) -> None:
        try:
            sent = _CarriedPose.model_validate_json(message.data)
        except ValidationError:
            return
        now, pose = self._node.now, pose_of_numbers(sent.pose)
        late = self._delays.take(now - 1e-9 * sent.stamp, time.monotonic())
        if pose is not None and not late and sent.frame == self._frame:
            self._remote.receive(CarriedPose(sent.session, sent.stamp, pose, sent.reference), now)


def _word(told: CarryTold) -> CarryWord:
    tool = None if told.tool is None else pose_of_numbers(told.tool)
    return CarryWord(told.session, told.to, told.leads, tool, told.refusal)
