"""Teleoperate one arm as a ROS node. Another robot needs a subclass with its own names, see arm_controllers.py."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from quest2ros.msg import OVR2ROSInputs
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from q2r2_control.config.bindings import Action
from q2r2_control.config.presets import BUILTIN
from q2r2_control.config.teleop import GuardSettings, TeleopSettings
from q2r2_control.errors import ConfigError
from q2r2_control.events import Reason
from q2r2_control.ros.base_node import ERROR, OK, WARN, BaseNode
from q2r2_control.ros.bridge.arm_feedback import ArmFeedback, listen_to_condition
from q2r2_control.ros.bridge.arm_outputs import ArmOutputs
from q2r2_control.ros.bridge.frames import FrameListener, PoseTopic, ToolFrame
from q2r2_control.ros.bridge.gripper_client import GripperClient, OpeningGrants
from q2r2_control.ros.bridge.hand_topics import HandIntake
from q2r2_control.ros.bridge.live_parameters import LiveArmParameters, is_of_teleop
from q2r2_control.ros.bridge.parameters import ArmDefaults, ArmParameters, arm_parameters, teleop_defaults
from q2r2_control.ros.bridge.target_output import near
from q2r2_control.ros.bridge.teleop_loop import TeleopLoop, TickInputs
from q2r2_control.ros.reasons import RosReason
from q2r2_control.teleop.arm import OPEN
from q2r2_control.teleop.arm_states import AT_REST, HOLDING, ArmState
from q2r2_control.teleop.hand_motion import MAX_OFFSET
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import SIDES, ArmTarget
from q2r2_control.wording import sentence

_WITHOUT_HAND = ArmState.CARRIED, ArmState.HOMING  # States in which the arm does not need its hand.


class BaseArmController(BaseNode):
    """A node that lets one arm follow one hand.

    It receives the topics of the hand, and publishes the target pose, gripper goals, markers and vibrations. Its name
    is ``<arm_name>_<robot_name>_arm_controller``. The other arguments are defaults of the parameters with the same
    names. ``preset`` names what the arm's controller requires: topic, rate, speeds, and what it needs in pauses.
    ``filter_window_size``, in samples of a 75 Hz headset, sets ``teleop.filter.smoothing_delay``. ``partner`` is the
    node of the other arm in this process, see ``run_arms`` of :mod:`arm_controllers`. Both arms then share one
    teleoperation, as in ``q2r2 run``. Without ``partner``, a fault pauses this node's own arm only.

    Methods to override: :meth:`setup_parameters`, :meth:`setup_state`, :meth:`setup_interfaces`, :meth:`current_pose`,
    :meth:`pose_callback`, :meth:`inputs_callback`, :meth:`toggle_gripper`.
    """

    ticks = True

    def __init__(
        self,
        arm_name: str,
        robot_name: str = "q2r2",
        mirror: bool = False,
        base_frame_id: str = "world",
        filter_window_size: int | None = None,
        end_effector_link_name: str = "",
        ctrl_prefix: str = "",
        gripper_action_topic: str = "",
        preset: str = BUILTIN.name,
        partner: BaseArmController | None = None,
        **kwargs: Any,
    ) -> None:
        if arm_name not in SIDES:
            raise ConfigError(f"arm_name = {arm_name!r:.60}: allowed are {', '.join(SIDES)}")
        super().__init__(f"{arm_name}_{robot_name}_arm_controller", **kwargs)
        self.arm_name, self.robot_name = arm_name, robot_name
        self.defaults = ArmDefaults(
            arm_name=arm_name,
            ctrl_prefix=ctrl_prefix or f"{robot_name}/{arm_name}",
            base_frame_id=base_frame_id,
            end_effector_link_name=end_effector_link_name or f"{arm_name}_tool_frame",
            gripper_action_topic=gripper_action_topic or f"{robot_name}/{arm_name}_gripper/gripper_cmd",
            teleop=teleop_defaults(mirror, filter_window_size),
            preset=preset,
        )
        self._partner = partner
        try:
            self.parameters = self.setup_parameters()
            self.setup_state()
            self.setup_interfaces()
        except BaseException:
            self.destroy_node()  # A half-made node could keep the process from ending.
            raise
        # For its first log line, rclpy takes some 60 ms, because it searches all modules for the line's origin. This
        # line is logged now, so that an operator's press does not wait for this search.
        self.get_logger().info(f"the {self.hand} hand moves the target on {self.outputs.first.topic}")

    def setup_parameters(self) -> ArmParameters:
        """Declare the parameters, and return their values."""
        return arm_parameters(self, self.defaults)

    def setup_state(self) -> None:
        """Make the objects that keep the node's state."""
        self.loop: TeleopLoop = TeleopLoop() if self._partner is None else self._partner.loop
        self.loop.join(self)
        self._has_analog_gripper = self.parameters.teleop.bindings.words_of(Action.GRIPPER_ANALOG) is not None
        self._target = ArmTarget(None, OPEN)
        # These values are used until the first tick, which never comes if time stands still.
        not_begun = Reason(RosReason.NO_TOOL_POSE, cause=Reason(RosReason.NODE_BEGINS))
        self._refusal: tuple[bytes, Reason] | None = WARN, not_begun
        self.inputs = TickInputs(None, None, None, None)

    def setup_interfaces(self) -> None:
        """Make publishers, subscriptions, services, the action client and the timer."""
        values = self.parameters
        self._frames = FrameListener(self)
        within = self._frames.tree, values.world_frame, values.tool_timeout
        topic = values.current_pose_topic
        self._tool: PoseTopic | ToolFrame = (
            PoseTopic(self, topic, *within) if topic else ToolFrame(self, values.tool_frame, *within)
        )
        self._safe_target = PoseTopic(self, f"{values.builtin_node}/safe_target/{self.arm_name}", *within)
        timeout = values.teleop.gate.timeout
        own = type(self).pose_callback is BaseArmController.pose_callback
        on_pose = None if own else self.pose_callback
        self.intake = HandIntake(self, self.hand, timeout, on_pose, self.inputs_callback)
        self.outputs = ArmOutputs(self, self.arm_name, values, self._safe_target)
        self.feedback = ArmFeedback(self, self.arm_name, values, self.intake)
        grants = None
        if (controller := self.outputs.builtin) is not None:
            listen_to_condition(self, controller, self.arm_name, self.feedback.haptics.notice)
            grants = OpeningGrants(self, controller, self.arm_name, self.outputs.first.topic)
        self.gripper = GripperClient(self, values.gripper_topic, values.gripper, grants)
        self._live = LiveArmParameters(self, values.teleop, values.guard, self._change)
        self.add_post_set_parameters_callback(self._share_parameters)
        self.create_service(Trigger, "~/engage", self._on_engage)
        self.create_service(Trigger, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.loop.connect(self)

    def current_pose(self) -> pin.SE3 | None:
        """Return the tool's pose in the world frame; None if it is not known."""
        return self._tool.at(self.now)

    def pose_callback(self, message: PoseStamped) -> None:
        """Take a pose of the hand."""
        self.intake.put_pose(message)

    def inputs_callback(self, message: OVR2ROSInputs) -> None:
        """Take buttons, triggers and stick of the hand."""
        self.intake.put_inputs(message)

    def toggle_gripper(self) -> None:
        """Open or close the gripper, because the upper button was pressed."""
        self.gripper.toggle(self.now)

    def begin_tick(self, now: float) -> Reason | None:
        """Update :attr:`inputs` at ``now`` [s]. Return why the arm has to hold, whatever its hand does, or None."""
        tool, base, controlled = self.current_pose(), self._base(), self._safe_target.at(now)
        obstacle = self._obstacle(tool, base, controlled)
        silence = None if self.state in _WITHOUT_HAND else self.intake.silence(now)
        self._refusal = obstacle or (None if silence is None else (WARN, silence))
        reference = None if controlled is None else self._safe_target.stamp
        commanded = None if tool is None else self._commanded(tool, controlled)
        self._base_pose = base
        self.inputs = TickInputs(tool, commanded, reference, None if obstacle is None else obstacle[1])
        fault = self.outputs.take_fault(now) or (None if self._refusal is None else self._refusal[1])
        fault = fault or self.outputs.standstill(tool, self._tool.received, now)
        return None if self.state in HOLDING else fault

    def follow(self, target: ArmTarget, now: float, decided: float) -> Reason | None:
        """Publish the target and command the gripper; returns why the arm has to hold, or None.

        ``decided`` is the time at which the target was decided on [s].
        """
        if self.intake.hand != self.hand:
            self.intake.follow(self.hand)
        toggled, self._target = target.gripper != self._target.gripper, target
        tool, base = self.inputs.tool, self._base_pose
        # If this process was frozen meanwhile, the target is too old. It is not sent, and the next tick pauses the arm.
        sent = self.outputs.step(target.command, tool, base, now, decided, self.state)
        fault = self.outputs.relay(self.engaged, tool, base, now, decided)
        if self._has_analog_gripper:
            self.gripper.move(target.gripper, now)
        elif toggled:
            self.toggle_gripper()
        self.gripper.check(now)
        self.feedback.publish(self.engaged, target, sent, tool, self.gripper, self.hand, now)
        return fault

    def refuse(self, problem: Reason) -> None:
        """Let nobody engage the arm until the next tick."""
        self._refusal = ERROR, problem

    @property
    def hand(self) -> str:
        return self.loop.teleop.hand_of(self.arm_name)

    @property
    def state(self) -> ArmState:
        return self.loop.teleop.states[self.arm_name]

    @property
    def engaged(self) -> bool:
        return self.loop.teleop.engaged[self.arm_name]

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        output = self.outputs.first
        values = {
            "arm": self.arm_name,
            "state": str(self.state),
            "engaged": self.engaged,
            "ready": self._refusal is None and self.state not in (ArmState.STOPPED, ArmState.HOMING),
            "hand": self.hand,
            "hand_age": _rounded(self.now - self.intake.stamps[0]),
            "inputs_age": _rounded(self.now - self.intake.stamps[1]),
            "stance": str(self.parameters.teleop.stance),
            "preset": self.parameters.preset.name,
            "mode": str(self.parameters.mode),
            "target_topic": output.topic,
            "sent": self.outputs.sent,
            "targets_clipped": output.guard.clipped,
            "slip": round(self._target.slip, 4),
            "slip_angle": round(self._target.slip_angle, 4),
            "gripper": self.gripper.state,
            "last_event": self.feedback.last_line,
            "last_event_kind": self.feedback.last_kind,
            "paused_kind": self.feedback.paused_kind,
        }
        if self._refusal is not None:
            level, reason = self._refusal
            return level, sentence(reason), values | {"kind": str(reason.kind)}
        if self.gripper.problem is not None:
            return WARN, self.gripper.problem, values | {"kind": str(RosReason.GRIPPER_FAILED)}
        if (held := self.outputs.gripper_held) is not None:
            return WARN, held, values
        if self.state in AT_REST:
            # The last pause is shown, because the last event can be a refused press, whose reason no longer exists.
            return OK, f"ready to engage ({self.feedback.paused})", values
        return OK, self.feedback.last_line, values

    def _base(self) -> pin.SE3 | None:
        if self.parameters.base_frame == self.parameters.world_frame:
            return pin.SE3.Identity()
        placement = self._frames.tree.find(self.parameters.base_frame, self.parameters.world_frame)
        return None if placement is None else placement.pose

    def _obstacle(
        self, tool: pin.SE3 | None, base: pin.SE3 | None, controlled: pin.SE3 | None
    ) -> tuple[bytes, Reason] | None:
        """Return the level for the diagnostics and the reason why the arm may not be engaged now, or None.

        A silent hand is not considered here.
        """
        values = self.parameters
        if (conflict := self._conflict()) is not None:
            return ERROR, conflict
        if tool is None:
            why = self._tool.problem or Reason(RosReason.NO_CURRENT_POSE)
            return WARN, Reason(RosReason.NO_TOOL_POSE, cause=why)
        if base is None:
            return WARN, Reason.of(RosReason.NO_TRANSFORM, frame=values.base_frame, world=values.world_frame)
        unready = self.outputs.unready
        # If the safe target is far from an arm that holds, a press would engage the arm, and it would stop at once. The
        # arm is therefore unready. An arm that follows can lag behind the safe target.
        if self.outputs.builtin and self.state in HOLDING and (away := self.outputs.away(controlled, tool)):
            unready = unready or Reason(RosReason.CONTROLLER_REFUSES, cause=away)
            if self.state is ArmState.IDLE:
                self.get_logger().warning(sentence(away), once=True)
        return None if unready is None else (WARN, unready)

    def _conflict(self) -> Reason | None:
        """Return a reason if several nodes publish where only one node may, or disagree about a frame; else None."""
        return self.outputs.conflict or self.intake.conflict or self._frames.conflict(self.parameters.tool_frame)

    def _commanded(self, tool: pin.SE3, reference: pin.SE3 | None) -> pin.SE3:
        """Return the commanded tool pose, for leash and anchors.

        It is the tool pose of the controller's ``reference`` if this is known; otherwise the last target, or ``tool``.
        """
        if self.engaged:
            return self._target.command_for(tool) if reference is None else reference
        reference = reference or self.outputs.first.last_sent
        return reference if reference is not None and near(reference, tool, *MAX_OFFSET) else tool

    def _change(self, settings: TeleopSettings, guard: GuardSettings) -> str | None:
        problem = self.loop.change(settings)
        if problem is None:
            self.parameters = replace(self.parameters, teleop=settings, guard=guard)
            self.feedback.haptics.strength = settings.haptics.strength
            self.outputs.limit(guard)
        return None if problem is None else sentence(problem)

    def _share_parameters(self, parameters: Sequence[Parameter]) -> None:
        """Give changed parameters to the other node of the same teleoperation."""
        shared = [one for one in parameters if is_of_teleop(one.name)]
        for node in [node for node in self.loop.nodes if node is not self]:
            changed = [one for one in shared if node.get_parameter(one.name).value != one.value]
            if changed:
                node.set_parameters_atomically(changed)

    def _on_engage(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Engage the arm as a press of its hand would, under the same conditions. Do nothing if it already follows."""
        response.success = not self.engaged
        response.message = f"{self.arm_name} follows its hand already" if self.engaged else f"{self.arm_name}: pressed"
        if not self.engaged:
            self.loop.teleop.press_to_engage(self.arm_name)
        return response

    def _on_pause(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.loop.teleop.hold(self.now, Reason(TeleopReason.PAUSE_SERVICE), self.arm_name)
        response.success, response.message = True, f"{self.arm_name} is paused"
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Forget everything received, the held target and a stop of the operator. A press engages the arm again."""
        self.loop.teleop.reset(self.now, self.arm_name, Reason(TeleopReason.RESET_SERVICE))
        self.outputs.forget(self.now)
        response.success, response.message = True, f"{self.arm_name} is reset"
        return response


def _rounded(age: float) -> float | None:
    return round(age, 3) if math.isfinite(age) else None
