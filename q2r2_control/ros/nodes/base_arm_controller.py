"""Teleoperation of one arm as a node. Another robot is a subclass with its names, see left_arm_controller."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from quest2ros.msg import OVR2ROSInputs
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_srvs.srv import Trigger

from q2r2_control.config.bindings import Action
from q2r2_control.config.presets import BUILTIN
from q2r2_control.config.teleop import GuardSettings, TeleopSettings
from q2r2_control.errors import ConfigError
from q2r2_control.ros.base_node import ERROR, OK, WARN, BaseNode
from q2r2_control.ros.bridge.arm_conditions import listen_to_condition
from q2r2_control.ros.bridge.arm_feedback import ArmFeedback
from q2r2_control.ros.bridge.arm_outputs import ArmOutputs
from q2r2_control.ros.bridge.arm_pair import ArmPair
from q2r2_control.ros.bridge.frames import FrameListener, PoseTopic, ToolFrame
from q2r2_control.ros.bridge.grippers import GripperClient
from q2r2_control.ros.bridge.hand_intake import HandIntake
from q2r2_control.ros.bridge.home_client import HomeClient
from q2r2_control.ros.bridge.live_parameters import LiveArmParameters
from q2r2_control.ros.bridge.opening_grants import OpeningGrants
from q2r2_control.ros.bridge.parameters import ArmDefaults, ArmParameters, arm_parameters
from q2r2_control.ros.bridge.reports import RecorderLink
from q2r2_control.ros.bridge.target_output import near
from q2r2_control.ros.monitoring.arm_link import ArmLink
from q2r2_control.ros.monitoring.hand_listeners import PAUSED_BY_SERVICE
from q2r2_control.teleop.arm import OPEN
from q2r2_control.teleop.arm_states import AT_REST, HOLDING, ArmState
from q2r2_control.teleop.sag import MOST_SAG
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import SIDES, ArmTarget, Event

_TIME_PERIOD = 0.05  # [s]


class BaseArmController(BaseNode):
    """One arm follows one hand: hand topics in, target pose, gripper goals, markers and vibrations out.

    The node is ``<arm_name>_<robot_name>_arm_controller``; the other arguments are the defaults of parameters of that
    name. ``preset`` names the terms of the controller that is driven: topic, rate, speeds, what it needs in pauses.
    ``filter_window_size``, in samples of a 75 Hz headset, sets ``teleop.filter.smoothing_delay``.

    Steps to override: :meth:`setup_parameters`, :meth:`setup_state`, :meth:`setup_interfaces`, :meth:`current_pose`,
    :meth:`pose_callback`, :meth:`inputs_callback`, :meth:`toggle_gripper`.
    """

    ticks = True
    priority = 38

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
        **kwargs: Any,
    ) -> None:
        if arm_name not in SIDES:
            raise ConfigError(f"arm_name = {arm_name!r:.60}: allowed are {', '.join(SIDES)}")
        super().__init__(f"{arm_name}_{robot_name}_arm_controller", **kwargs)
        self.arm_name, self.robot_name = arm_name, robot_name
        self.defaults = ArmDefaults(
            arm_name=arm_name,
            robot_name=robot_name,
            mirror=mirror,
            base_frame_id=base_frame_id,
            end_effector_link_name=end_effector_link_name or f"{arm_name}_tool_frame",
            ctrl_prefix=ctrl_prefix or f"/{robot_name}/{arm_name}",
            gripper_action_topic=gripper_action_topic or f"/{robot_name}/{arm_name}_gripper/gripper_cmd",
            filter_window_size=filter_window_size,
            preset=preset,
        )
        try:
            self.parameters = self.setup_parameters()
            self.setup_state()
            self.setup_interfaces()
        except BaseException:
            self.destroy_node()  # a node that is never returned could keep the process from ending
            raise
        # For the origin of a process's first line rclpy looks through all modules, some 60 ms: not at the first press.
        self.get_logger().info(f"the {self.hand} hand moves the target on {self._outputs.first.topic}")

    def setup_parameters(self) -> ArmParameters:
        """Declare the parameters; returns what they say."""
        return arm_parameters(self, self.defaults)

    def setup_state(self) -> None:
        """Make the objects that keep the node's state."""
        self.teleop = Teleop(self.parameters.teleop, (self.arm_name,))
        self._has_analog_gripper = self.parameters.teleop.bindings.words_of(Action.GRIPPER_ANALOG) is not None
        self._target = ArmTarget(None, OPEN)
        self._refusal: tuple[bytes, str] | None = WARN, "has not begun yet"  # where time stands still it never does
        self._ticked = self.now

    def setup_interfaces(self) -> None:
        """Make publishers, subscriptions, services, the action client and the timer."""
        values = self.parameters
        self._frames = FrameListener(self)
        tree, world = self._frames.tree, values.world_frame
        self._tool: ToolFrame | PoseTopic = ToolFrame(self, tree, values.tool_frame, world, values.tool_timeout)
        if values.current_pose_topic:
            self._tool = PoseTopic(self, values.current_pose_topic, tree, world, values.tool_timeout)
        self._safe_target = PoseTopic(self, values.safe_target_topic, tree, world, values.tool_timeout)
        self._link = ArmLink(self, self.robot_name, self.arm_name, values.teleop.stance, values.link_timeout)
        self._pair = ArmPair(self, self._link, self.arm_name, values, self.teleop)
        timeout = values.teleop.gate.timeout
        self._hand = HandIntake(self, self.hand, timeout, self.pose_callback, self.inputs_callback)
        self._outputs = ArmOutputs(self, values, self._safe_target)
        self._feedback = ArmFeedback(self, self.arm_name, values, self._link, self._hand)
        self._recorder = RecorderLink(self, self.teleop.marks)
        grants = None
        if (controller := self._outputs.builtin) is not None:
            listen_to_condition(self, controller, self.arm_name, self._feedback.haptics.notice)
            grants = OpeningGrants(self, controller, self.arm_name, self._outputs.first.topic)
        self._home = HomeClient(self, self._outputs.home_controller)
        self.gripper = GripperClient(self, values.gripper_topic, values.gripper, grants)
        self._live = LiveArmParameters(self, values.teleop, values.guard, self._change)
        self.create_service(Trigger, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_tick(1.0 / values.rate, self.tick)
        # Without time there are no ticks, and so nothing else that would pause the arm.
        self.create_timer(_TIME_PERIOD, self._watch_time, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def current_pose(self) -> pin.SE3 | None:
        """The tool's pose in the world frame; None where it is not known."""
        return self._tool.at(self.now)

    def pose_callback(self, message: PoseStamped) -> None:
        """Take a pose of the hand."""
        self._hand.put_pose(message)

    def inputs_callback(self, message: OVR2ROSInputs) -> None:
        """Take buttons, triggers and stick of the hand."""
        self._hand.put_inputs(message)

    def toggle_gripper(self) -> None:
        """The upper button was pressed."""
        self.gripper.toggle(self.now)

    def tick(self) -> None:
        """Process what arrived, and publish where the tool should go."""
        decided, now, tool = time.monotonic(), self.now, self.current_pose()
        base = self._base()
        self._pair.hear(self._safe_target.stamp if self._safe_target.at(now) is not None else None)
        self._refusal = self._refuse(tool, base, now)
        obstacle = None if self._refusal is None else self._refusal[1]
        fault = self._faults(now) or obstacle
        if fault is not None and self.state not in HOLDING:
            self.teleop.pause(now, fault)
        self._pair.agree(now)
        samples, arm = self._hand.take(), self.arm_name
        tools = {} if tool is None else {arm: tool}
        commanded = {} if tool is None else {arm: self._commanded(tool, now)}
        obstacles = {} if obstacle is None else {arm: obstacle}
        for reason in self._recorder.update():
            self._feedback.haptics.tell(Event(now, arm, self.state, self.state, reason))
        target = self.teleop.update(samples, tools, now, commanded or None, obstacles)[arm]
        if self._hand.hand != self.hand:
            self._hand.follow(self.hand)
        self._home.update(self.teleop, *self._outputs.homing, now)
        toggled = target.gripper != self._target.gripper
        self._target = target
        # If this process was frozen meanwhile, the target is out of date: it is not sent, and the next tick pauses.
        sent = self._outputs.step(target.command, tool, base, now, decided)
        if (fault := self._outputs.relay(self.engaged, tool, base, now, decided)) is not None:
            self.teleop.pause(now, fault)
        self._pair.send(now, decided)
        if self._has_analog_gripper:
            self.gripper.move(target.gripper, now)
        elif toggled:
            self.toggle_gripper()
        self.gripper.check(now)
        self._publish_events()
        self._pair.tell()  # after the events, so that a fault is told before what it ends
        self._feedback.publish(self.engaged, target, sent, tool, self.gripper, self.hand, now)

    @property
    def hand(self) -> str:
        """The hand that drives the arm."""
        return self.teleop.hand_of(self.arm_name)

    @property
    def state(self) -> ArmState:
        """State of the teleop layer."""
        return self.teleop.states[self.arm_name]

    @property
    def engaged(self) -> bool:
        """Whether the arm follows a hand."""
        return self.teleop.engaged[self.arm_name]

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        """State, the reason why the arm cannot be engaged, and figures."""
        output = self._outputs.first
        values = {
            "arm": self.arm_name,
            "state": str(self.state),
            "engaged": self.engaged,
            "ready": self._refusal is None and self.state not in (ArmState.STOPPED, ArmState.HOMING),  # to be engaged
            "hand": self.hand,
            "hand_age": _rounded(self.now - self._hand.stamps[0]),
            "inputs_age": _rounded(self.now - self._hand.stamps[1]),
            "stance": str(self.parameters.teleop.stance),
            "preset": self.parameters.preset.name,
            "mode": str(self.parameters.mode),
            "target_topic": output.topic,
            "sent": self._outputs.sent | self._pair.sent,
            "targets_clipped": output.guard.clipped,
            "slip": round(self._target.slip, 4),
            "slip_angle": round(self._target.slip_angle, 4),
            "gripper": self.gripper.state,
            "last_event": self._feedback.last_event,
        }
        if self._refusal is not None:
            return *self._refusal, values
        for problem in (self.gripper.problem, self._outputs.gripper_held, self._outputs.advice, self._frames.advice):
            if problem is not None:
                return WARN, problem, values
        if self.state in AT_REST:
            return OK, f"ready to engage ({self._feedback.paused})", values  # whatever refused an earlier press is over
        return OK, self._feedback.last_event, values

    def close(self) -> None:
        """Announce the end of this node to the other arm."""
        self._link.close()

    def _base(self) -> pin.SE3 | None:
        """The frame that targets are published in, in the world frame."""
        if self.parameters.base_frame == self.parameters.world_frame:
            return pin.SE3.Identity()
        placement = self._frames.tree.find(self.parameters.base_frame, self.parameters.world_frame)
        return None if placement is None else placement.pose

    def _refuse(self, tool: pin.SE3 | None, base: pin.SE3 | None, now: float) -> tuple[bytes, str] | None:
        """Why the arm may not be engaged now, with the level of the diagnostics."""
        frames = self._frames.conflict(self.parameters.tool_frame)
        for line in (self._link.disagreement, self._outputs.conflict, frames):
            if line is not None:
                return ERROR, line
        if tool is None:
            return WARN, f"the tool's pose is not known: {self._tool.problem or 'current_pose() gives none'}"
        if base is None:
            values = self.parameters
            return WARN, f"no transform from {values.base_frame} to {values.world_frame} on /tf"
        carried = self.state is ArmState.CARRIED or self._pair.asked  # for which no hand is needed
        silence = None if carried else self._hand.silence(now)
        problem = self._link.swapping or self._link.aligning or silence or self._outputs.unready
        return None if problem is None else (WARN, problem)

    def _faults(self, now: float) -> str | None:
        """What pauses this arm, besides its hand. A gap in its own ticks comes first: it makes others look silent."""
        linked = self._link.take_fault(self.parameters.teleop.linked)
        output = self._outputs.take_fault(now)
        # Read after the others were judged: the process may have been frozen in the middle of this tick.
        gap, self._ticked = self.now - self._ticked, now
        stalled = f"this node stood still for {gap:.2f} s" if gap > self.parameters.teleop.gate.timeout else None
        return stalled or output or linked

    def _watch_time(self) -> None:
        """Pause where simulated time stands still: the hand goes on, and must not be followed later."""
        problem = self.clock_problem(self.parameters.teleop.gate.timeout)
        if problem is None:
            return
        self._refusal = ERROR, problem
        if self.state not in HOLDING:
            self.teleop.pause(self.now, problem)
            self._publish_events()

    def _commanded(self, tool: pin.SE3, now: float) -> pin.SE3:
        """The commanded tool pose: the leash is measured from it, and an anchor takes its orientation and the sag.

        Another controller's is not known. Then the leash is measured from the tool, and the last target is what that
        controller holds while the arm is paused.
        """
        reference = self._safe_target.at(now)
        if self.engaged:
            return self._target.command_for(tool) if reference is None else reference
        reference = reference or self._outputs.first.last_sent
        return reference if reference is not None and near(reference, tool, *MOST_SAG) else tool

    def _publish_events(self) -> None:
        for event in self.teleop.take_events():
            self._feedback.tell(event)

    def _change(self, settings: TeleopSettings, guard: GuardSettings) -> str | None:
        turned = settings.stance is not self.parameters.teleop.stance
        problem = self._link.turning_refused if turned else None
        if problem is None and settings != self.parameters.teleop:
            problem = self.teleop.change(settings, self.now)
        if problem is None:
            self.parameters = replace(self.parameters, teleop=settings, guard=guard)
            self._feedback.haptics.strength = settings.haptics.strength
            self._link.set_stance(settings.stance)
            self._outputs.limit(guard)
        return problem

    def _on_pause(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.teleop.pause(self.now, PAUSED_BY_SERVICE)
        response.success, response.message = True, f"{self.arm_name} is paused"
        return response

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Drop all that was received, the held target and a stop of the operator's; a press engages again."""
        now = self.now
        self.teleop.connection_lost(now)
        self.teleop.set_stopped(False, now, "the reset service")
        self._link.set_stopped(False)
        self._outputs.forget(now)
        response.success, response.message = True, f"{self.arm_name} is reset"
        return response


def _rounded(duration: float) -> float | None:
    return round(duration, 3) if math.isfinite(duration) else None
