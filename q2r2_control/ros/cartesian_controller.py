"""``cartesian_controller``: the built-in controller for all arms of a cell, between target poses and joint commands.

Targets come in on a topic an arm, ``/q2r2/left/target_frame`` for the left one. The parameters ``left.target_topic``
and ``left.target_frame_id`` make it any other, be it a controller an arm in one namespace
(``/robot/left_arm_clik_controller/target_frame``) or a namespace an arm (``/left/target_pose``). What is done with
targets: :mod:`supervisor`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from q2r2_control.config import load_config
from q2r2_control.control.controller import LONGEST_DT, CartesianController
from q2r2_control.errors import ConfigError
from q2r2_control.robot.compose import WORLD
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.joint_watch import WatchSettings
from q2r2_control.ros.messages import pose_of, robot_state, stamped_pose
from q2r2_control.ros.node import COMMAND_QOS, ERROR, OK, STREAM_QOS, WARN, BaseNode, run_node
from q2r2_control.ros.outputs import make_output
from q2r2_control.ros.supervisor import Phase, Supervisor
from q2r2_control.ros.target_stream import StreamSettings
from q2r2_control.types import Reference, RobotState

_LONGEST_STOP = 3.0  # [s]
_RECENT = 1.0  # refused targets are a warning for this long [s]

# Parameters that may change while the node runs: name, unit or meaning, least and greatest value.
_STREAM_PARAMETERS = (
    ("timeout", "target_timeout", "an arm without targets for this long holds [s]", 0.02, 2.0),
    ("engage_distance", "engage_distance", "targets have to begin this near to the tool [m]", 0.0, 0.2),
    ("engage_angle", "engage_angle", "and turned from it by no more [rad]", 0.0, 1.5),
)
_WATCH_PARAMETERS = (
    ("timeout", "joint_state_timeout", "without joint states for this long the arms brake [s]", 0.01, 1.0),
    ("settle_time", "settle_time", "joint states have to be good and at rest before activation [s]", 0.02, 10.0),
    ("deviation", "max_deviation", "of a joint from its reference [rad]", 0.01, 3.0),
    ("deviation_time", "deviation_time", "for this long stops the arms [s]", 0.05, 10.0),
)


class CartesianControllerNode(BaseNode):
    """Feeds a :class:`Supervisor` from its topics and publishes the reference that comes of it."""

    def __init__(self) -> None:
        super().__init__("cartesian_controller")
        config = load_config(self.parameter("config", "config/dual_iiwa7.yaml", "YAML of the cell"))
        rate = self.parameter("rate", 250.0, "of the control loop [Hz]", at_least=20, at_most=1000)
        self._robot = Robot.from_config(config)
        self._frames = {arm: self._frame_of(arm) for arm in self._robot.arms}
        self._streams, self._watch = StreamSettings(), WatchSettings()
        self._settings: dict[str, tuple[Any, str]] = {}
        for target, table in ((self._streams, _STREAM_PARAMETERS), (self._watch, _WATCH_PARAMETERS)):
            self._declare(target, table)
        self.add_post_set_parameters_callback(self._on_parameters)
        self._output = make_output(
            self.parameter("output", "trajectory", "trajectory, float64, joint_state, lbr_position, lbr_torque"),
            self.parameter("output_topic", "", "joint commands; empty: the output's usual one"),
            self,
            self._robot,
            config,
            1.0 / rate,
            self._topics("lbr_topic", "/{arm}/command/lbr_joint_position_command", "LBR commands"),
        )
        self._target_topics = self._topics("target_topic", "/q2r2/{arm}/target_frame", "targets")
        self._controller = CartesianController(self._robot, config.control)
        self._supervisor = Supervisor(self._robot, self._controller, self._streams, self._watch)
        self._measured: RobotState | None = None
        self._reference: Reference | None = None
        self._refused: dict[str, _Refusal] = {}
        self._rejected = dict.fromkeys(self._robot.arms, 0)
        self._ticks, self._reported_at, self._last_tick = 0, time.monotonic(), self.now
        self._connect()
        self.create_timer(1.0 / rate, self._tick)
        self._period = 1.0 / rate
        self.get_logger().info(f"{config.name}: {', '.join(self._robot.arms)}; waits for joint states")

    def _declare(self, target: Any, table: tuple[tuple[str, str, str, float, float], ...]) -> None:
        for field, name, description, least, greatest in table:
            value = self.parameter(
                name, getattr(target, field), description, at_least=least, at_most=greatest, read_only=False
            )
            setattr(target, field, value)
            self._settings[name] = (target, field)

    def _on_parameters(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name in self._settings:
                target, field = self._settings[parameter.name]
                setattr(target, field, parameter.value)

    def _frame_of(self, arm: str) -> _Frame:
        """An arm's frame of targets."""
        name = self.parameter(
            f"{arm}.target_frame_id",
            WORLD,
            "frame_id that targets have to have: a link that does not move, or any other name for the cell's world",
        )
        model = self._robot.model
        if name == WORLD or not model.existFrame(name, pin.FrameType.BODY):
            return _Frame(name, pin.SE3.Identity())
        frame = model.frames[model.getFrameId(name, pin.FrameType.BODY)]
        if frame.parentJoint != 0:
            raise ConfigError(f"{arm}.target_frame_id = {name!r:.60}: that link moves; allowed: one that does not")
        return _Frame(name, frame.placement.copy())

    def _topics(self, name: str, default: str, what: str) -> dict[str, str]:
        """A topic for each arm; ``default`` has {arm} where the arm's name goes."""
        topics: dict[str, str] = {}
        for arm in self._robot.arms:
            topic = self.parameter(f"{arm}.{name}", default.format(arm=arm), f"topic of {what} of this arm")
            if topic in topics.values():
                raise ConfigError(f"{arm}.{name} = {topic!r:.80}: another arm has it; allowed: a topic of its own")
            topics[arm] = topic
        return topics

    def _connect(self) -> None:
        for arm, topic in self._target_topics.items():
            self.create_subscription(PoseStamped, topic, partial(self._on_target, arm), COMMAND_QOS)
        self.create_subscription(JointState, "joint_states", self._on_joint_state, STREAM_QOS)
        self._safe_targets = {
            arm: self.create_publisher(PoseStamped, f"~/safe_target/{arm}", COMMAND_QOS) for arm in self._robot.arms
        }
        self.create_service(SetBool, "~/pause", self._on_pause)
        services: dict[str, Callable[[], str | None]] = {
            "home": self._supervisor.go_home,
            "reset": self._supervisor.reset,
            "stop": self._stop,
        }
        for name, act in services.items():
            self.create_service(Trigger, f"~/{name}", partial(_serve, act))

    def _on_joint_state(self, message: JointState) -> None:
        names = self._robot.joint_names
        if not set(names) & set(message.name):
            return  # of a gripper or another robot
        now = self.now
        state = robot_state(message, names, now)
        if isinstance(state, RobotState):
            self._measured = state
        self._supervisor.take_joint_state(state, now)

    def _on_target(self, arm: str, message: PoseStamped) -> None:
        frame = self._frames[arm]
        if message.header.frame_id != frame.name:
            self._refuse(arm, "frame", f"frame_id {message.header.frame_id!r:.40}; allowed: {frame.name!r}")
            return
        pose = pose_of(message.pose)
        if pose is None:
            self._refuse(arm, "pose", "not a finite pose with a unit quaternion")
            return
        refusal = self._supervisor.take_target(arm, frame.pose * pose, self.now)
        if refusal is None:
            self._refused.pop(arm, None)
        else:
            self._refuse(arm, "stream", refusal)

    def _refuse(self, arm: str, kind: str, fault: str) -> None:
        """Say why targets are not used: once for each kind of fault, until one is used again or none come any more."""
        self._rejected[arm] += 1
        before = self._refused.get(arm)
        self._refused[arm] = _Refusal(kind, fault, self.now)
        if before is None or before.kind != kind:
            self.get_logger().warning(f"target of {arm} not used: {fault}")
            self.report_health()

    def _tick(self) -> None:
        now = self.now
        # A late tick moves the arms no faster; a clock that was set back moves nothing.
        dt = min(now - self._last_tick, LONGEST_DT)
        self._last_tick = now
        self._ticks += 1
        if dt > 0.0:
            self._advance(now, dt)

    def _advance(self, now: float, dt: float) -> None:
        was_active = self._supervisor.phase is Phase.ACTIVE
        reference = self._supervisor.tick(now, dt)
        if not was_active and self._supervisor.phase is Phase.ACTIVE and self._measured is not None:
            self._output.activate(self._measured)
        if reference is not None and self._measured is not None:
            self._output.send(reference, self._measured, dt, now)
            self._reference = reference
            self._publish_safe_targets(now)
        self._tell_events()

    def _publish_safe_targets(self, now: float) -> None:
        for arm, publisher in self._safe_targets.items():
            if publisher.get_subscription_count():
                frame = self._frames[arm]
                tool = frame.pose.actInv(self._controller.tool_pose(arm))
                publisher.publish(stamped_pose(tool, frame.name, now))

    def _tell_events(self) -> None:
        if not self._supervisor.events:
            return
        for event in self._supervisor.events:
            self.get_logger().warning(event)
        self._supervisor.events.clear()
        self.report_health()

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._supervisor.pause(request.data)
        return _answer(response, None)

    def _stop(self) -> str | None:
        self._supervisor.stop("stopped by ~/stop; ~/reset activates again")
        return None

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        supervisor, now, wall = self._supervisor, self.now, time.monotonic()
        values: dict[str, Any] = {
            "phase": supervisor.phase,
            "loop_rate_hz": round(self._ticks / max(wall - self._reported_at, 1e-9), 1),
        }
        self._ticks, self._reported_at = 0, wall
        for arm, topic in self._target_topics.items():
            values[f"{arm}_state"] = "paused" if supervisor.paused else supervisor.arm_state(arm)
            age = supervisor.target_age(arm, now)
            values[f"{arm}_target_age_s"] = round(age, 3) if age < 1e6 else "none"
            values[f"{arm}_targets_rejected"] = self._rejected[arm]
            values[f"{arm}_target_publishers"] = self.count_publishers(topic)
        if self._reference is not None:
            report = self._reference.report
            values["qp_status"] = str(report.status)
            values["closest_pair"] = "|".join(report.closest_pair)
            values["closest_distance_m"] = round(report.closest_distance, 4)
        level, line = self._judge()
        return level, line, values

    def _judge(self) -> tuple[bytes, str]:
        if self._supervisor.fault is not None:
            return ERROR, self._supervisor.fault
        crowded = [arm for arm, topic in self._target_topics.items() if self.count_publishers(topic) > 1]
        recent = {arm: refusal for arm, refusal in self._refused.items() if self.now - refusal.stamp <= _RECENT}
        self._refused = recent
        lines = [f"target of {arm} not used: {refusal.fault}" for arm, refusal in recent.items()]
        lines += [f"{self._target_topics[arm]} has more than one publisher" for arm in crowded]
        return (WARN, "; ".join(lines)) if lines else (OK, "paused" if self._supervisor.paused else "active")

    def close(self) -> None:
        """Bring the arms to rest along the certified stop before the commands end."""
        self._supervisor.stop("ending")
        deadline = time.monotonic() + _LONGEST_STOP
        while self._supervisor.phase is Phase.BRAKING and time.monotonic() < deadline:
            time.sleep(self._period)
            self._advance(self.now, self._period)  # simulated time may have ended already


@dataclass(frozen=True, slots=True)
class _Refusal:
    """Why an arm's last target was not used."""

    kind: str
    fault: str
    stamp: float  # [s]


@dataclass(frozen=True, slots=True)
class _Frame:
    """What target poses are given in."""

    name: str
    pose: pin.SE3  # in the world


def _serve(act: Callable[[], str | None], request: Any, response: Any) -> Any:
    return _answer(response, act())


def _answer(response: Any, refusal: str | None) -> Any:
    response.success, response.message = refusal is None, refusal or "done"
    return response


def main() -> int:
    """The executable ``cartesian_controller``."""
    return run_node(CartesianControllerNode)


if __name__ == "__main__":
    sys.exit(main())
