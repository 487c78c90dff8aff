"""Send one arm's target to the controller that moves the arm, directly or through the built-in controller."""

from __future__ import annotations

import json
import math
import time
from importlib import import_module
from typing import Any

import pinocchio as pin
from std_msgs.msg import Bool, String

from q2r2_control.config.presets import BUILTIN, POSE, TWIST, Mode
from q2r2_control.config.teleop import GuardSettings
from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason
from q2r2_control.ros.base_node import LATCHED_QOS, STREAM_QOS, BaseNode
from q2r2_control.ros.bridge.frames import PoseTopic
from q2r2_control.ros.bridge.parameters import ArmParameters
from q2r2_control.ros.bridge.target_output import TargetOutput
from q2r2_control.ros.commanders import takers_of
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.supervision.standstill import LAGGING_TOOL, StandstillWatch, standing
from q2r2_control.supervision.target_stream import apart
from q2r2_control.teleop.arm_states import ArmState
from q2r2_control.teleop.hand_motion import MAX_OFFSET

_COMMAND_TYPES = {TWIST: 1, POSE: 2}  # The constants of moveit_msgs/srv/ServoCommandType.
# States in which the built-in controller reports that an arm accepts a stream of targets.
_READY = ("holding", "following", "homing")
_ANSWER = 0.2  # After this time the controller has reported the end of all earlier streams [s].
_LOOK_PERIOD = 0.04  # Time between two queries of the graph for the controller [s].
_STATE_TYPE = "std_msgs/msg/String"
_SILENT = 2.0  # A controller without a report for this time does not answer. It reports twice a second [s].
_RETRY = 1.0  # The service is called again after this time without an answer [s].


class ArmOutputs:
    """The outputs of one arm: one in mode raw, and up to two in mode filtered.

    In mode filtered, ``first`` sends the hand's target to the built-in controller. The safe target that this controller
    publishes is relayed to the arm's own controller. The relay starts when the arm is engaged, if the safe target is
    near the measured tool. It continues during pauses, so that the arm comes to rest as the built-in controller does.
    """

    def __init__(self, node: BaseNode, arm: str, values: ArmParameters, safe_target: PoseTopic) -> None:
        preset, self._filtered = values.preset, values.mode is Mode.FILTERED
        self._safe_target, self._tool_frame = safe_target, values.tool_frame
        self._relay: TargetOutput | None = None  # The output that relays the safe target; None in mode raw.
        if self._filtered:
            topic = BUILTIN.topic.format(ctrl=values.builtin_prefix)
            self.first = TargetOutput(
                node, values, BUILTIN, values.builtin_node, topic, values.world_frame, BUILTIN.guard
            )
        if not self._filtered or (preset.takes_targets and preset is not BUILTIN):
            terms = values.controller, values.target_topic, values.base_frame, values.guard
            theirs = TargetOutput(node, values, preset, *terms)
            if self._filtered:
                self._relay = theirs
            else:
                self.first = theirs
        self._all = [self.first] if self._relay is None else [self.first, self._relay]
        self._follows: FollowWatch | None = None
        # ``builtin`` is the name of the built-in controller if this controller gets the hand's targets; otherwise None.
        # ``home_controller`` is this name if the built-in controller also moves the arm home; otherwise None.
        self.builtin = values.builtin_node if self.first.preset is BUILTIN else None
        self.home_controller = None if self._filtered else self.builtin
        if self.first.preset is BUILTIN:
            # The timeout is twice the usual timeout, because the controller reports only after a target has arrived.
            self._follows = FollowWatch(node, values.builtin_node, arm, 2.0 * values.listener_timeout)
        service = preset.command_type
        self._command_type = (
            None if service is None else CommandType(node, service.format(ctrl=values.prefix), preset.message)
        )
        self._safe_problem: Reason | None = self._safe_target.problem  # Why the relay cannot begin now, or None.
        self._relaying = False
        raw = not self._filtered and preset is not BUILTIN
        # The built-in controller needs no such watch. Its reference can rest on purpose, such as near an obstacle, and
        # is known here from its safe targets.
        self._stands = StandstillWatch(LAGGING_TOOL) if raw else None
        self._node, self._arm = node, arm

    def limit(self, guard: GuardSettings) -> None:
        """Change the limits of the targets for the preset's controller, from the next target on."""
        output = self._relay if self._filtered else self.first
        if output is not None:
            output.guard.change(guard)

    @property
    def conflict(self) -> Reason | None:
        """The reason if an output's topic has other publishers, or None."""
        return next((conflict for output in self._all if (conflict := output.conflict)), None)

    @property
    def unready(self) -> Reason | None:
        """The reason why the arm may not be engaged yet, or None."""
        if unready := next((unready for output in self._all if (unready := output.unready)), None):
            return unready
        if self._relay is not None and not self._relaying:
            unready = self._safe_problem
        if unready is None and self._follows is not None:
            unready = self._follows.unready
        if unready is None and self._command_type is not None:
            unready = self._command_type.unready
        return _refused(unready)

    @property
    def homing(self) -> tuple[bool, Reason | None]:
        """Whether the built-in controller reports a motion home, and how the last one ended (None if not known)."""
        return (False, None) if self._follows is None else (self._follows.homing, self._follows.homing_outcome)

    @property
    def gripper_held(self) -> str | None:
        """Return which pair of bodies keeps the gripper from its requested opening, or None.

        The built-in controller reports this pair.
        """
        why = "" if self._follows is None else self._follows.gripper_held
        return f"the gripper goes no farther: {why}" if why else None

    @property
    def sent(self) -> dict[str, int]:
        return {output.topic: output.sent for output in self._all}

    def take_fault(self, now: float) -> Reason | None:
        """Check the controllers. If a fault of a controller has to pause the arm, return the reason once."""
        faults = [output.take_fault(now) for output in reversed(self._all)]
        if self._relay is not None and faults[0] is not None:
            self._relaying = False
        if self._command_type is not None:
            self._command_type.step(self._all[-1].starts, now)
        if self._follows is not None:
            self._follows.notice(self.first.starts)
            faults += [self._safe_target.take_silence(now), self._follows.refusal(self.first.following, now)]
        return _refused(next((fault for fault in faults if fault), None))

    def standstill(self, tool: pin.SE3 | None, received: float, now: float) -> Reason | None:
        """Return a reason if the controller receives targets and does not move the tool, else None.

        ``received`` is the time at which the tool was measured [s].
        """
        asked = self.first.last_sent
        if self._stands is None or tool is None or asked is None or not self.first.following:
            return None
        if (distance := self._stands.look(asked.translation, tool.translation, received, now)) is None:
            return None
        self.forget(now)  # If the last target were sent again, the arm could jump.
        takers = f" {name}" if (name := takers_of(self._node, self.first.topic)) else ""
        return _refused(standing(self._arm, takers, distance, "m"))

    def step(
        self,
        target: pin.SE3 | None,
        tool: pin.SE3 | None,
        base: pin.SE3 | None,
        now: float,
        decided: float,
        state: ArmState,
    ) -> pin.SE3 | None:
        return self.first.step(target, tool, pin.SE3.Identity() if self._filtered else base, now, decided, state=state)

    def relay(
        self, engaged: bool, tool: pin.SE3 | None, base: pin.SE3 | None, now: float, decided: float
    ) -> Reason | None:
        """Pass on the safe target of the built-in controller. Return why the arm has to pause, or None."""
        if self._relay is None:
            return None
        safe, fault = self._safe_target.at(now), None
        self._safe_problem = self._safe_target.problem if safe is None else self.away(safe, tool)
        if not self._relaying and engaged:
            self._relaying, fault = self._safe_problem is None and tool is not None, self._safe_problem
        self._relaying = self._relaying and safe is not None
        # The stream starts at the measured tool, because the safe target can differ from it by the arm's steady-state
        # offset.
        self._relay.step(safe if self._relaying else None, tool, base, now, decided, start=tool)
        return _refused(fault)

    def away(self, safe: pin.SE3 | None, tool: pin.SE3 | None) -> Reason | None:
        """Return a reason if the safe target is so far from the measured tool that no relay may begin, else None."""
        if safe is None or tool is None:
            return None
        distance, angle = apart(safe, tool)
        if distance <= MAX_OFFSET[0] and angle <= MAX_OFFSET[1]:
            return None
        kind, topic, frame = RosReason.SAFE_TARGET_AWAY, self._safe_target.topic, self._tool_frame
        return Reason.of(kind, topic=topic, frame=frame, distance=distance, angle=angle)

    def forget(self, now: float) -> None:
        for output in self._all:
            output.forget(now)
        self._relaying = False


class FollowWatch:
    """Watches whether the built-in controller follows an arm's targets, as its topic ``~/following/<arm>`` reports.

    The controller drops a stream for its own reasons, such as missing joint states. After that it accepts only a new
    stream, for which the arm has to be paused. The controller is ready only while it reports on ``~/state``. If it does
    not report, it may have no joint states, or it may be a different controller, which must not get these targets.
    """

    def __init__(self, node: BaseNode, controller: str, arm: str, timeout: float) -> None:
        self.controller, self._arm, self._timeout = controller, arm, timeout
        self._topic = f"{controller}/following/{arm}"
        self._follows: bool | None = None
        self._since = math.inf  # Time since which targets have been sent and not followed [s].
        self._followed_since = math.inf  # Time since which targets have been sent and followed [s].
        self._node, self._state_topic = node, f"{controller}/state"
        self._unready: Reason | None = None  # Why the controller is not ready, by its newest report, or None.
        # The number of the controller's starts, and the time of its newest report [s].
        self._starts, self._reported_at = 0, -math.inf
        # Whether a node publishes ``~/state``, and the time at which the graph was last asked for it [s].
        self._is_there, self._looked = False, -math.inf
        self.homing = False  # Whether the controller reports that it goes home.
        self.homing_outcome: Reason | None = None  # How the last motion home ended; None if nothing is reported.
        self.gripper_held = ""  # The pair of bodies that stops the gripper; empty if no pair does.
        node.create_subscription(Bool, self._topic, self._on_following, LATCHED_QOS)
        node.create_subscription(String, self._state_topic, self._on_state, STREAM_QOS)

    @property
    def unready(self) -> Reason | None:
        """The reason why the controller would not follow a stream of targets now, or None."""
        if (now := time.monotonic()) - self._looked > _LOOK_PERIOD:
            self._looked, self._is_there = now, bool(self._node.count_publishers(self._state_topic))
        if not self._is_there:
            kind, topic = RosReason.CONTROLLER_ABSENT, self._state_topic
            return Reason.of(kind, controller=self.controller, topic=topic, type=_STATE_TYPE)
        if (age := now - self._reported_at) <= _SILENT:
            return self._unready
        if age == math.inf:
            return Reason.of(RosReason.TOPIC_EMPTY, topic=self._state_topic)
        return Reason.of(RosReason.TOPIC_SILENT, topic=self._state_topic, source="", age=age)

    def notice(self, starts: int) -> None:
        """Forget the reports of an earlier controller; ``starts`` counts how often a controller has appeared."""
        if starts != self._starts:
            self._starts, self._reported_at, self._unready = starts, -math.inf, None

    def refusal(self, sending: bool, now: float) -> Reason | None:
        """Return a reason if the controller does not follow the targets that are sent, else None.

        Either it has ceased to follow them, or it has not begun within the timeout.
        """
        if self.homing:
            return None
        followed = sending and self._follows is True
        if followed or not sending:
            self._since = math.inf
            self._followed_since = min(self._followed_since, now) if followed else math.inf
            return None
        # If the controller seemed to follow for less than _ANSWER, it never followed this stream. Its report that an
        # earlier stream had ended came late.
        dropped = now - self._followed_since > _ANSWER
        self._since, self._followed_since = min(self._since, now), math.inf
        if not (dropped or now - self._since > self._timeout):
            return None
        return Reason.of(RosReason.FOLLOWED_NO_MORE if dropped else RosReason.NOT_FOLLOWED, topic=self._topic)

    def _on_following(self, message: Bool) -> None:
        self._follows = bool(message.data)

    def _on_state(self, message: String) -> None:
        self._reported_at = time.monotonic()
        try:
            said = json.loads(message.data)
            state, fault, outcome = said[f"{self._arm}_state"], said["fault"], said["homing_outcome"]
            self._unready = self._refusal_of(state, None if fault is None else Reason.from_json(fault))
            self.homing_outcome = None if outcome is None else Reason.from_json(outcome)
        except (ValueError, TypeError, KeyError):
            self._node.drop(self._state_topic, f"{message.data!r:.60}")
            return
        self.homing, self.gripper_held = state == "homing", str(said.get(f"{self._arm}_gripper_held_by", ""))

    def _refusal_of(self, state: str, fault: Reason | None) -> Reason | None:
        if state in _READY:
            return None
        if state == "paused":
            return Reason.of(RosReason.CONTROLLER_ON_PAUSE, controller=self.controller)
        if fault is None:
            return Reason.of(SupervisionReason.CONTROLLER_PHASE, phase=state)
        if fault.kind is RosReason.CONTROLLER_DEACTIVATED:
            return fault
        kind = RosReason.CONTROLLER_STOPPED if state == "stopped" else RosReason.CONTROLLER_FAULT
        return Reason.of(kind, fault, controller=self.controller, phase=state)


class CommandType:
    """Tells MoveIt Servo after each of its starts which type of targets it will get.

    Raises :class:`ConfigError` if moveit_msgs is missing.
    """

    def __init__(self, node: BaseNode, service: str, message: str = POSE) -> None:
        """``message`` is the type of the targets, :data:`POSE` or :data:`TWIST`."""
        try:
            self._kind: Any = import_module("moveit_msgs.srv").ServoCommandType
        except ImportError as error:
            raise ConfigError(f"{service} is a service of moveit_msgs, which cannot be imported: {error}") from None
        self._type = _COMMAND_TYPES[message]
        self._service, self._client = service, node.create_client(self._kind, service)
        self._starts, self._agreed, self._asked = -1, False, -math.inf
        self._answer: Any = None  # The future of the last call.

    @property
    def unready(self) -> Reason | None:
        return None if self._agreed else Reason.of(RosReason.NO_POSE_COMMANDS, service=self._service)

    def step(self, starts: int, now: float) -> None:
        """Call the service if a call is due; ``starts`` counts how often the controller has appeared."""
        if starts != self._starts:
            self._starts, self._agreed, self._asked, self._answer = starts, False, -math.inf, None
        if self._answer is not None and self._answer.done():
            self._agreed, self._answer = bool(self._answer.result().success), None
        if not self._agreed and now - self._asked > _RETRY and self._client.service_is_ready():
            self._asked = now
            self._answer = self._client.call_async(self._kind.Request(command_type=self._type))


def _refused(why: Reason | None) -> Reason | None:
    return None if why is None else Reason(RosReason.CONTROLLER_REFUSES, cause=why)
