"""Where one arm's target goes: to the controller that moves the arm, or through the built-in one to it."""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import pinocchio as pin
from rclpy.node import Node
from std_msgs.msg import Bool

from q2r2_control.config.presets import BUILTIN, Mode
from q2r2_control.ros.base_node import LATCHED_QOS, BaseNode
from q2r2_control.ros.bridge.frames import PoseTopic
from q2r2_control.ros.bridge.parameters import ArmParameters
from q2r2_control.ros.bridge.target_output import TargetOutput, near

# Farther from the measured pose than sag explains, a commanded one is not where the tool is.
SAG = 0.05, 0.1  # [m, rad]
_BUILTIN_NODE = "/cartesian_controller"
_POSE = 2  # of moveit_msgs/srv/ServoCommandType
_PATIENCE = 1.0  # for an answer, before asking again [s]


class ArmOutputs:
    """One output in mode raw. In mode filtered ``first`` is the built-in controller's, and what that allows is relayed.

    The relay begins when the arm is engaged and the built-in controller's tool is where the arm's is. It lasts through
    pauses, so that the arm comes to rest as the built-in controller does.
    """

    def __init__(self, node: BaseNode, values: ArmParameters, safe_target: PoseTopic) -> None:
        preset, self._filtered = values.preset, values.mode is Mode.FILTERED
        self._safe_target, self._safe_topic = safe_target, values.safe_target_topic
        self._last: TargetOutput | None = None
        if self._filtered:
            topic = BUILTIN.topic.format(ctrl=values.builtin_prefix)
            self.first = TargetOutput(
                node, BUILTIN, _BUILTIN_NODE, topic, values.world_frame, BUILTIN.guard, values.listener_timeout
            )
        if not self._filtered or (preset.takes_poses and preset is not BUILTIN):
            theirs = TargetOutput(
                node,
                preset,
                values.controller,
                values.target_topic,
                values.base_frame,
                values.guard,
                values.listener_timeout,
                values.prefix,
            )
            if self._filtered:
                self._last = theirs
            else:
                self.first = theirs
        self._follows: FollowWatch | None = None
        if self.first.preset is BUILTIN:
            # Twice as long as anything else may be silent: the targets have to arrive, and the answer.
            self._follows = FollowWatch(node, values.following_topic, 2.0 * values.listener_timeout)
        self._all = [self.first] if self._last is None else [self.first, self._last]
        self._command_type: CommandType | None = None
        if preset.command_type is not None:
            self._command_type = CommandType(node, preset.command_type.format(ctrl=values.prefix))
        self._allows = False  # the built-in controller says where the arm may go
        self._relaying = False

    @property
    def conflict(self) -> str | None:
        """One line on publishers that should not be there."""
        return next((line for output in self._all if (line := output.conflict)), None)

    @property
    def unready(self) -> str | None:
        """Why the arm may not be engaged yet."""
        if unheard := next((line for output in self._all if (line := output.unheard)), None):
            return unheard
        if self._last is not None and not self._allows:
            return self._safe_target.problem
        return None if self._command_type is None else self._command_type.unready

    @property
    def advice(self) -> str | None:
        """What the user has to do, since it cannot be done here."""
        return None if self._command_type is None else self._command_type.advice

    def take_fault(self, now: float) -> str | None:
        """Look who is there; says once that a controller was started anew while it was driven."""
        faults = [output.take_fault(now) for output in reversed(self._all)]
        if self._last is not None and faults[0] is not None:
            self._relaying = False
        if self._command_type is not None:
            self._command_type.step(self._all[-1].lives, now)
        if self._follows is not None:
            faults += [self._safe_target.take_silence(now), self._follows.refusal(self.first.following, now)]
        return next((fault for fault in faults if fault), None)

    def step(self, target: pin.SE3 | None, tool: pin.SE3 | None, base: pin.SE3 | None, now: float) -> pin.SE3 | None:
        """Send the hand's target, see :meth:`TargetOutput.step`."""
        return self.first.step(target, tool, pin.SE3.Identity() if self._filtered else base, now)

    def relay(self, engaged: bool, tool: pin.SE3 | None, base: pin.SE3 | None, now: float) -> str | None:
        """Pass on what the built-in controller allows; returns why the arm has to pause."""
        if self._last is None:
            return None
        safe, fault = self._safe_target.at(now), None
        self._allows = safe is not None
        if not self._relaying and engaged:
            self._relaying = safe is not None and tool is not None and near(safe, tool, *SAG)
            if not self._relaying:
                fault = self._safe_target.problem or f"{self._safe_topic} is not where the tool is"
        self._relaying = self._relaying and safe is not None
        # The built-in controller's tool may be where the arm's is not, as far as the arm sags.
        self._last.step(safe if self._relaying else None, tool, base, now, start=tool)
        return fault

    def forget(self, now: float) -> None:
        """Hold nothing any more."""
        for output in self._all:
            output.forget(now)
        self._relaying = False


class FollowWatch:
    """Without it an arm would count as engaged whose targets the controller refuses, and a press would pause it.

    The controller refuses a stream that it has dropped for reasons of its own, such as joint states that stalled, and
    may follow again only what begins anew. One that says nothing, as those of others, is believed to follow.
    """

    def __init__(self, node: Node, topic: str, patience: float) -> None:
        self._topic, self._patience = topic, patience
        self._follows: bool | None = None
        self._since = math.inf  # targets are sent that are not followed [s]
        node.create_subscription(Bool, topic, self._take, LATCHED_QOS)

    def refusal(self, asked: bool, now: float) -> str | None:
        """One line where targets, which are sent as long as ``asked``, have not been followed for too long."""
        if not asked or self._follows is not False:
            self._since = math.inf
            return None
        self._since = min(self._since, now)
        return f"{self._topic} says that targets are not followed" if now - self._since > self._patience else None

    def _take(self, message: Bool) -> None:
        self._follows = bool(message.data)


class CommandType:
    """Asks for poses until the service agrees, again whenever its node has come anew; nothing here waits.

    Without moveit_msgs it cannot ask: ``advice`` says so, and engaging is then the user's to decide.
    """

    def __init__(self, node: BaseNode, service: str) -> None:
        self._service, self._client = service, None
        self.advice: str | None = None
        try:
            self._kind: Any = import_module("moveit_msgs.srv").ServoCommandType
        except ImportError:
            self.advice = f"moveit_msgs cannot be imported: call {service} with {_POSE} yourself"
            return
        self._client = node.create_client(self._kind, service)
        self._lives, self._agreed = -1, False
        self._asked = float("-inf")
        self._answer: Any = None  # future

    @property
    def unready(self) -> str | None:
        """Why poses do not count yet."""
        if self._client is None or self._agreed:
            return None
        return f"{self._service} has not agreed to poses yet"

    def step(self, lives: int, now: float) -> None:
        """Ask where that is due; ``lives``: how often the controller was seen to come."""
        if self._client is None:
            return
        if lives != self._lives:
            self._lives, self._agreed, self._asked = lives, False, float("-inf")
            self._forget()
        if self._answer is not None and self._answer.done():
            self._agreed = bool(self._answer.result().success)
            self._answer = None
        if not self._agreed and now - self._asked > _PATIENCE and self._client.service_is_ready():
            self._forget()
            self._asked = now
            self._answer = self._client.call_async(self._kind.Request(command_type=_POSE))

    def _forget(self) -> None:
        """An answer that is late is one of the past."""
        if self._answer is not None and self._client is not None:
            self._client.remove_pending_request(self._answer)
        self._answer = None
