"""What the built-in controller grants grippers: openings that are proven, since fingers and what they hold are bodies.

Whoever commands a gripper tells the opening that is wanted, and the one that was commanded last, on the topic of the
arm's targets with ``/wanted_opening`` after it, and commands what ``~/opening/<arm>`` answers: the wanted opening and
the one that may be commanded now, 0 closed .. 1 fully open. Where nobody has asked yet, or fingers were never measured,
they count as all of their way, for which nothing needs to be known. So they do where another controller moves the arms.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from q2r2_control.config.cell import Config
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.control.controller import CartesianController
from q2r2_control.loop.control_loop import ControlLoop
from q2r2_control.ros.base_node import LATCHED_QOS, BaseNode
from q2r2_control.ros.bridge.gripper_client import wanted_topic

# Until a gripper does what was granted: the answer has to arrive, ten goals a second go out, and it may be slow [s].
GRIPPER_DELAY = 0.3
# Until the message of a publisher that was there before this node has arrived, on a busy machine too [s].
_DISCOVERY = 1.0
_UNMEASURED = "its fingers are not in the joint states, or nothing is proven while the arms are stopped"


class GripperLimits:
    """Asks the control loop for openings, and answers with those that it grants."""

    def __init__(self, node: BaseNode, config: Config, loop: ControlLoop, targets: Mapping[str, str]) -> None:
        """``targets``: topic of the targets of each arm whose gripper may ask."""
        self._node, self._loop = node, loop
        self._fingers = FingerStates(config, loop.controller)
        self.wanted: dict[str, float] = {}  # arm -> opening, 0 closed .. 1 fully open
        self._began = time.monotonic()
        self._answered: dict[str, tuple[float, float]] = {}
        self._answers: dict[str, Any] = {}
        for arm in (arm for arm in self._fingers.arms if arm in targets):
            self._answers[arm] = node.create_publisher(Float64MultiArray, f"~/opening/{arm}", LATCHED_QOS)
            topic = wanted_topic(targets[arm])
            node.create_subscription(Float64MultiArray, topic, partial(self._on_wanted, arm), LATCHED_QOS)

    @property
    def held(self) -> dict[str, str]:
        """Arm -> what keeps its gripper from the wanted opening."""
        openings = self._loop.granted_openings.items()
        held = {arm: _UNMEASURED for arm, (wanted, granted) in openings if granted != wanted}
        pairs = self._loop.held_grippers.items()
        return held | {arm: f"{'|'.join(pair)} would come too close" for arm, pair in pairs}

    def openings(self, now: float) -> dict[str, float]:
        """See :meth:`FingerStates.openings`."""
        return self._fingers.openings(now)

    def take_joint_state(self, message: JointState) -> None:
        """Keep the fingers of a message of joint states, if there are any."""
        if self._answers:
            self._fingers.take(message, self._node.now)

    def awaits(self, now: float) -> bool:
        """Whether the opening of a measured gripper may have been commanded, and is not known here yet.

        Its fingers would count as all of their way: arms that rest near something with closed grippers would back off.
        """
        if time.monotonic() - self._began > _DISCOVERY:
            return False
        return any(arm in self._answers and arm not in self.wanted for arm in self.openings(now))

    def answer(self) -> None:
        """Publish what the loop has granted, where that is new."""
        for arm, answer in self._loop.granted_openings.items():
            if self._answered.get(arm) != answer:
                self._answered[arm] = answer
                self._answers[arm].publish(Float64MultiArray(data=answer))

    def _on_wanted(self, arm: str, message: Float64MultiArray) -> None:
        told = list(message.data)
        if len(told) != 2 or not 0.0 <= told[0] <= 1.0 or (told[1] == told[1] and not 0.0 <= told[1] <= 1.0):
            allowed = "two, wanted and commanded last (or NaN), 0 closed .. 1 open"
            self._node.get_logger().warning(f"{arm}: openings {told!s:.60} not used; allowed: {allowed}")
            return
        wanted, commanded = told
        if arm not in self.wanted and commanded == commanded:
            # Asked for before this node began, maybe long ago: the gripper is where it was commanded to be, and stays.
            now = self._node.now
            self._loop.resume_gripper(arm, wanted, commanded, self.openings(now), now)
            self.answer()
        self.wanted[arm] = wanted


class FingerStates:
    """How far grippers are open, from joint states that have their fingers' joints."""

    def __init__(self, config: Config, controller: CartesianController) -> None:
        robot = controller.robot
        grippers = {str(arm): each.gripper for arm, each in config.arms.items()}
        self.arms = [arm for arm in robot.arms if robot.arms[arm].stroke > 0.0 or arm in robot.objects.by_arm]
        self._grippers = {
            arm: (robot.arms[arm].finger_joints, grippers[arm].closed_position, grippers[arm].open_position)
            for arm in self.arms
            if robot.arms[arm].stroke > 0.0
        }
        self._measured: dict[str, tuple[float, float]] = {}  # arm -> opening, and when it was measured [s]

    def take(self, message: JointState, now: float) -> None:
        """Note what a message says of fingers; what it says of other joints is not looked at."""
        if len(message.position) != len(message.name):
            return
        positions = dict(zip(message.name, message.position, strict=True))
        for arm, (joints, closed, opened) in self._grippers.items():
            if positions.keys() >= set(joints):
                position = sum(positions[joint] for joint in joints) / len(joints)
                self._measured[arm] = ((position - closed) / (opened - closed), now)

    def openings(self, now: float) -> dict[str, float]:
        """Of the arms whose fingers were measured just now, 0 closed .. 1 fully open; a little beyond is possible."""
        return {
            arm: opening
            for arm, (opening, at) in self._measured.items()
            if now - at <= STREAM_TIMEOUT and math.isfinite(opening)
        }
