"""Teleoperation of one arm as a node. Another robot is a subclass with its names, see left_arm_controller."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from quest2ros.msg import OVR2ROSHapticFeedback, OVR2ROSInputs
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker

from q2r2_control.config.bindings import Action
from q2r2_control.config.presets import BUILTIN
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.samples import SampleQueue
from q2r2_control.inputs.session import HAPTIC_TOPICS
from q2r2_control.ros.base_node import COMMAND_QOS, ERROR, OK, STREAM_QOS, WARN, BaseNode
from q2r2_control.ros.bridge.arm_outputs import SAG, ArmOutputs
from q2r2_control.ros.bridge.frames import FrameListener, PoseTopic, ToolFrame
from q2r2_control.ros.bridge.grippers import GripperClient
from q2r2_control.ros.bridge.hand_topics import HandWatch
from q2r2_control.ros.bridge.home_client import HomeClient
from q2r2_control.ros.bridge.live_parameters import LiveTeleopParameters
from q2r2_control.ros.bridge.markers import TargetMarkers
from q2r2_control.ros.bridge.messages import age, hand_sample
from q2r2_control.ros.bridge.parameters import ArmDefaults, ArmParameters, arm_parameters
from q2r2_control.ros.bridge.target_output import near
from q2r2_control.ros.monitoring.arm_link import ArmLink
from q2r2_control.ros.monitoring.hand_listeners import PAUSED_BY_SERVICE
from q2r2_control.teleop.arm import OPEN
from q2r2_control.teleop.arm_states import AT_REST, HOLDING, ArmState, is_refusal
from q2r2_control.teleop.haptics import HapticPulses
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import SIDES, ArmTarget

_MARKER_PERIOD = 0.05  # [s]


class BaseArmController(BaseNode):
    """One arm follows one hand: hand topics in, target pose, gripper goals, markers and vibrations out.

    The node is ``<arm_name>_<robot_name>_arm_controller``; the other arguments are the defaults of parameters of that
    name. ``preset`` names the terms of the controller that is driven: topic, rate, speeds, what it needs in pauses.
    ``filter_window_size``, in samples of a 75 Hz headset, sets ``teleop.filter.smoothing_delay``.

    Steps to override: :meth:`setup_parameters`, :meth:`setup_state`, :meth:`setup_interfaces`, :meth:`current_pose`,
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

    def setup_parameters(self) -> ArmParameters:
        """Declare the parameters; returns what they say."""
        return arm_parameters(self, self.defaults)

    def setup_state(self) -> None:
        """Make the objects that keep the node's state."""
        self.teleop = Teleop(self.parameters.teleop, (self.arm_name,))
        self.hand = self.teleop.hand_of(self.arm_name)
        self.haptics = HapticPulses(self.parameters.teleop.haptics)
        self.markers = TargetMarkers(self.arm_name, self.parameters.tool_frame, self.parameters.world_frame)
        self._has_analog_gripper = self.parameters.teleop.bindings.words_of(Action.GRIPPER_ANALOG) is not None
        self._samples = SampleQueue()
        self._pose: tuple[PoseStamped, float] | None = None
        self._inputs: tuple[OVR2ROSInputs | None, float] = (None, float("-inf"))
        self._target = ArmTarget(None, OPEN)
        self._last_event = self._paused = "not engaged yet"
        self._refusal: tuple[bytes, str] | None = None
        self._shown = 0.0
        self._received = self._ticked = self.now  # the message of the hand that is being taken was

    def setup_interfaces(self) -> None:
        """Make publishers, subscriptions, services, the action client and the timer."""
        values, hand = self.parameters, self.hand
        self._frames = FrameListener(self)
        tree, world = self._frames.tree, values.world_frame
        self._tool: ToolFrame | PoseTopic = ToolFrame(self, tree, values.tool_frame, world, values.tool_timeout)
        if values.current_pose_topic:
            self._tool = PoseTopic(self, values.current_pose_topic, tree, world, values.tool_timeout)
        self._safe_target = PoseTopic(self, values.safe_target_topic, tree, world, values.tool_timeout)
        self._link = ArmLink(self, self.robot_name, self.arm_name, values.teleop.stance, values.link_timeout)
        self._hand_watch = HandWatch(self, hand, values.teleop.gate.timeout)
        self._outputs = ArmOutputs(self, values, self._safe_target)
        self._home = HomeClient(self, self._outputs.home_controller)
        self.gripper = GripperClient(self, values.gripper_topic, values.gripper)
        self._markers = self.create_publisher(Marker, "/visualization_marker", 10)
        self._haptics = self.create_publisher(OVR2ROSHapticFeedback, HAPTIC_TOPICS[hand], COMMAND_QOS)
        for kind, topic, callback in (
            (PoseStamped, f"q2r_{hand}_hand_pose", self.pose_callback),
            (OVR2ROSInputs, f"q2r_{hand}_hand_inputs", self.inputs_callback),
        ):
            self.create_subscription(kind, topic, partial(self._take, callback), STREAM_QOS)
        self._live = LiveTeleopParameters(self, values.teleop, self._change_teleop)
        self.create_service(Trigger, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_timer(1.0 / values.rate, self.tick)

    def current_pose(self) -> pin.SE3 | None:
        """The tool's pose in the world frame; None where it is not known."""
        return self._tool.at(self.now)

    def pose_callback(self, message: PoseStamped) -> None:
        """Take a pose of the hand."""
        self._pose = message, self._received
        self._put_sample()

    def inputs_callback(self, message: OVR2ROSInputs) -> None:
        """Take buttons, triggers and stick of the hand."""
        self._inputs = message, self._received
        self._put_sample()

    def toggle_gripper(self) -> None:
        """The upper button was pressed."""
        self.gripper.toggle(self.now)

    def tick(self) -> None:
        """Process what arrived, and publish where the tool should go."""
        decided, now, tool = time.monotonic(), self.now, self.current_pose()
        base = self._base()
        self._refusal = self._refuse(tool, base, now)
        obstacle = None if self._refusal is None else self._refusal[1]
        fault = self._faults(now) or obstacle
        if fault is not None and self.state not in HOLDING:
            self.teleop.pause(now, fault)
        if self._link.stopped != self.teleop.stopped:
            self.teleop.set_stopped(self._link.stopped, now, f"the {self._link.other} arm's operator")
        samples, arm = self._samples.take(), self.arm_name
        tools = {} if tool is None else {arm: tool}
        commanded = {} if tool is None else {arm: self._commanded(tool, now)}
        obstacles = {} if obstacle is None else {arm: obstacle}
        target = self.teleop.update(samples, tools, now, commanded or None, obstacles)[arm]
        self._link.set_stopped(self.teleop.stopped)
        self._home.update(self.teleop, *self._outputs.homing, now)
        toggled = target.gripper != self._target.gripper
        self._target = target
        # If this process was frozen meanwhile, the target is out of date: it is not sent, and the next tick pauses.
        sent = self._outputs.step(target.pose, tool, base, now, decided)
        if (fault := self._outputs.relay(self.state is ArmState.ENGAGED, tool, base, now, decided)) is not None:
            self.teleop.pause(now, fault)
        if self._has_analog_gripper:
            self.gripper.move(target.gripper, now)
        elif toggled:
            self.toggle_gripper()
        self.gripper.check(now)
        self._publish_events(now)
        self._publish_feedback(sent, tool, now)

    @property
    def state(self) -> ArmState:
        """State of the teleop layer."""
        return self.teleop.states[self.arm_name]

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        """State, the reason why the arm cannot be engaged, and figures."""
        output = self._outputs.first
        values = {
            "arm": self.arm_name,
            "state": str(self.state),
            "engaged": self.state is ArmState.ENGAGED,
            "ready": self._refusal is None and self.state not in (ArmState.STOPPED, ArmState.HOMING),  # to be engaged
            "hand": self.hand,
            "hand_age": round(self.now - self._pose[1], 3) if self._pose else None,
            "inputs_age": round(self.now - self._inputs[1], 3) if self._inputs[0] else None,
            "stance": str(self.parameters.teleop.stance),
            "preset": self.parameters.preset.name,
            "mode": str(self.parameters.mode),
            "target_topic": output.topic,
            "targets_sent": output.sent,
            "targets_clipped": output.guard.clipped,
            "slip": round(self._target.slip, 4),
            "slip_angle": round(self._target.slip_angle, 4),
            "gripper": self.gripper.state,
            "last_event": self._last_event,
        }
        if self._refusal is not None:
            return *self._refusal, values
        for problem in (self.gripper.problem, self._outputs.advice):
            if problem is not None:
                return WARN, problem, values
        if self.state in AT_REST:
            return OK, f"ready to engage ({self._paused})", values  # whatever refused an earlier press is over
        return OK, self._last_event, values

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
        for line in (self._link.disagreement, self._outputs.conflict):
            if line is not None:
                return ERROR, line
        if tool is None:
            return WARN, f"the tool's pose is not known: {self._tool.problem or 'current_pose() gives none'}"
        if base is None:
            values = self.parameters
            return WARN, f"no transform from {values.base_frame} to {values.world_frame} on /tf"
        silence = self._hand_watch.silence(now, self._pose[1] if self._pose else float("-inf"), self._inputs[1])
        problem = silence or self._outputs.unready
        return None if problem is None else (WARN, problem)

    def _faults(self, now: float) -> str | None:
        """What pauses this arm, besides its hand. A gap in its own ticks comes first: it makes others look silent."""
        linked = self._link.take_fault() if self.parameters.teleop.linked else None
        output = self._outputs.take_fault(now)
        # Read after the others were judged: the process may have been frozen in the middle of this tick.
        gap, self._ticked = self.now - self._ticked, now
        stalled = f"this node stood still for {gap:.2f} s" if gap > self.parameters.teleop.gate.timeout else None
        return stalled or output or linked

    def _commanded(self, tool: pin.SE3, now: float) -> pin.SE3:
        """The commanded tool pose: the leash is measured from it, and an anchor takes its orientation."""
        reference = self._safe_target.at(now)
        if self.state is ArmState.ENGAGED:
            return tool if reference is None else reference
        reference = reference or self._outputs.first.guard.pose
        return reference if reference is not None and near(reference, tool, *SAG) else tool

    def _publish_events(self, now: float) -> None:
        """Report changes of the state: to the log, to the hand as vibrations, and to the other arm."""
        for event in self.teleop.take_events():
            self._last_event = f"{event.destination}: {event.reason}"
            if event.destination in AT_REST and not is_refusal(event):
                self._paused = self._last_event
            self.get_logger().info(self._last_event)
            self.haptics.tell(event)
            if event.destination is ArmState.ENGAGED:
                self._link.engaged()
            stopped = event.source not in AT_REST and event.destination in (ArmState.LOST, ArmState.ALIGNING)
            if stopped and not self._link.told(event.reason):
                self._link.report(event.reason)
            self.report_health()

    def _publish_feedback(self, sent: pin.SE3 | None, tool: pin.SE3 | None, now: float) -> None:
        """Publish markers and vibrations."""
        self.haptics.slip(self._target.slip, self._target.slip_angle)
        if (pulse := self.haptics.at(now, self.hand)) is not None:
            self._haptics.publish(OVR2ROSHapticFeedback(frequency=pulse.frequency, amplitude=pulse.amplitude))
        if not 0.0 <= now - self._shown < _MARKER_PERIOD:
            self._shown = now
            for marker in self.markers.at(sent, tool, self.state is ArmState.ENGAGED, now):
                self._markers.publish(marker)

    def _take(self, callback: Callable[[Any], None], message: Any, info: Mapping[str, Any]) -> None:
        self._received = self.now - age(info)
        callback(message)

    def _put_sample(self) -> None:
        if self._pose is not None:
            self._samples.put(hand_sample(self.hand, *self._pose, *self._inputs))

    def _change_teleop(self, settings: TeleopSettings) -> str | None:
        problem = self.teleop.change(settings, self.now)
        if problem is None:
            self.parameters = replace(self.parameters, teleop=settings)
            self.haptics.strength = settings.haptics.strength
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
