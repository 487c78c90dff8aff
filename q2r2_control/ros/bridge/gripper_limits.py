"""What the built-in controller grants grippers: openings that are proven, since fingers and what they hold are bodies.

Whoever commands a gripper tells the opening that is wanted, and the one that was commanded last, on the topic of the
arm's targets with ``/wanted_opening`` after it, and commands what ``~/opening/<arm>`` answers: the wanted opening and
the one that may be commanded now, 0 closed .. 1 fully open. Where nobody has asked yet, or fingers were never measured,
they count as all of their way, for which nothing needs to be known. So they do where another controller moves the arms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any

from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from q2r2_control.config.cell import Config
from q2r2_control.config.timeouts import STREAM_TIMEOUT
from q2r2_control.control.controller import CartesianController
from q2r2_control.drives.base import Drive
from q2r2_control.ros.base_node import LATCHED_QOS, BaseNode
from q2r2_control.ros.bridge.opening_grants import wanted_topic
from q2r2_control.loop.geometry_updates import GeometryUpdates
from q2r2_control.supervision.grasp_watch import STALL, GraspWatch

# Until a gripper does what was granted: the answer has to arrive, ten goals a second go out, and it may be slow [s].
_GRIPPER_DELAY = 0.3
_UNMEASURED = "its fingers are not in the joint states, or nothing is proven while the arms are stopped"


class GripperLimits:
    """Fingers, held objects and distances of the controller, for all arms; see :class:`GeometryUpdates`."""

    def __init__(
        self,
        node: BaseNode,
        config: Config,
        controller: CartesianController,
        drive: Drive,
        targets: Mapping[str, str],
    ) -> None:
        """``targets``: topic of the targets of each arm whose gripper may ask."""
        self._node, self._controller, self._drive = node, controller, drive
        self._fingers = FingerStates(config, controller)
        self._grasps = GraspWatch(controller, STALL + _GRIPPER_DELAY)
        self._wanted: dict[str, float] = {}
        self._told: dict[str, tuple[float, float]] = {}
        self._bodies: GeometryUpdates | None = None  # while the controller's reference is where the arms are
        self._answers: dict[str, Any] = {}
        for arm in (arm for arm in self._fingers.arms if arm in targets):
            self._answers[arm] = node.create_publisher(Float64MultiArray, f"~/opening/{arm}", LATCHED_QOS)
            topic = wanted_topic(targets[arm])
            node.create_subscription(Float64MultiArray, topic, partial(self._on_wanted, arm), LATCHED_QOS)

    @property
    def held(self) -> dict[str, str]:
        """Arm -> what keeps its gripper from the wanted opening."""
        pairs = {} if self._bodies is None else self._bodies.held_grippers
        held = {arm: _UNMEASURED for arm, (wanted, granted) in self._told.items() if granted != wanted}
        return held | {arm: f"{'|'.join(pair)} would come too close" for arm, pair in pairs.items()}

    @property
    def holding(self) -> dict[str, bool]:
        """Of each arm that has an object, whether its gripper holds it."""
        return {} if self._bodies is None else self._bodies.holding

    def take_joint_state(self, message: JointState) -> None:
        """Note the fingers of a message of joint states, if there are any."""
        if self._answers:
            self._fingers.take(message, self._node.now)

    def prepare(self) -> None:
        """The controller was reset; before the drive is."""
        self._grasps.tell_again()
        self._bodies = GeometryUpdates(self._controller, self._drive, _GRIPPER_DELAY, self._grasps)

    def begin(self, now: float) -> None:
        """The drive was reset."""
        assert self._bodies is not None
        granted = {arm: granted for arm, (_, granted) in self._told.items()}
        self._bodies.resume(granted, self._fingers.openings(now), now)
        self._bodies.begin()

    def limit(self, active: bool, now: float) -> None:
        """Answer what was asked for, before a step.

        An inactive controller moves no arm and proves nothing: it grants what it is asked for then, for instance to let
        go of something, but no gripper that was held goes on in that direction because the arms were stopped.
        """
        if not active:
            self._bodies = None
        if not self._wanted:
            return
        if self._bodies is not None:
            granted = self._bodies.limit_grippers(self._wanted, self._fingers.openings(now), now)
        else:
            granted = {arm: without_proof(wanted, self._told.get(arm)) for arm, wanted in self._wanted.items()}
        for arm, opening in granted.items():
            self._answer(arm, self._wanted[arm], opening)

    def _answer(self, arm: str, wanted: float, granted: float) -> None:
        if self._told.get(arm) != (wanted, granted):
            self._told[arm] = wanted, granted
            self._answers[arm].publish(Float64MultiArray(data=(wanted, granted)))

    def after_step(self) -> None:
        """See :meth:`GeometryUpdates.after_step`."""
        if self._bodies is not None:
            self._bodies.after_step()

    def _on_wanted(self, arm: str, message: Float64MultiArray) -> None:
        told = list(message.data)
        if len(told) != 2 or not 0.0 <= told[0] <= 1.0 or (told[1] == told[1] and not 0.0 <= told[1] <= 1.0):
            allowed = "two, wanted and commanded last (or NaN), 0 closed .. 1 open"
            self._node.get_logger().warning(f"{arm}: openings {told!s:.60} not used; allowed: {allowed}")
            return
        wanted, commanded = told
        if arm not in self._wanted and commanded == commanded:
            # Asked for before this node began, maybe long ago: the gripper is where it was commanded to be, and stays.
            self._answer(arm, wanted, commanded)
            if self._bodies is not None:
                now = self._node.now
                self._bodies.resume({arm: commanded}, self._fingers.openings(now), now)
        self._wanted[arm] = wanted


def without_proof(wanted: float, told: tuple[float, float] | None) -> float:
    """What is granted while the arms do not move; ``told`` is what was wanted and granted before."""
    if told is None or told[0] == told[1]:
        return wanted
    return min(wanted, told[1]) if told[0] > told[1] else max(wanted, told[1])


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
        for arm, (joints, closed, opened) in self._grippers.items():
            if columns := _columns(tuple(message.name), joints):
                position = sum(message.position[column] for column in columns) / len(joints)
                self._measured[arm] = ((position - closed) / (opened - closed), now)

    def openings(self, now: float) -> dict[str, float]:
        """Of the arms whose fingers were measured just now, 0 closed .. 1 fully open; a little beyond is possible."""
        return {
            arm: opening
            for arm, (opening, at) in self._measured.items()
            if now - at <= STREAM_TIMEOUT and math.isfinite(opening)
        }


@lru_cache(maxsize=64)  # publishers send the same names again and again
def _columns(given: tuple[str, ...], joints: tuple[str, ...]) -> list[int]:
    """Where ``joints`` are among the names of a message; empty where one is missing."""
    return [given.index(joint) for joint in joints] if set(joints) <= set(given) else []
