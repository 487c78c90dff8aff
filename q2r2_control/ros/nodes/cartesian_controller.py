"""``cartesian_controller``: the built-in controller for all arms of a cell, between target poses and joint commands.

Every topic is one of all arms or one an arm, as the robot's layout asks for: targets on ``/q2r2/left/target_frame`` or
``left.target_topic``, joint states on ``joint_states`` or ``left.joint_states_topic``, commands on ``output_topic`` or
``left.output_topic``. So a controller an arm in one namespace (``/robot/left_arm_controller/joint_trajectory``) and a
namespace an arm (``/left/joint_states``) both work. With output ``none`` another controller moves the arms and only
``~/safe_target/left`` is published for it. What is done with targets: :mod:`supervisor`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from std_msgs.msg import Bool
from std_srvs.srv import SetBool, Trigger

from q2r2_control.config import Config, load_config
from q2r2_control.control.controller import CartesianController
from q2r2_control.drives import TorqueDrive, permitted
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import ERROR, LATCHED_QOS, OK, SENT_COMMAND_QOS, WARN, BaseNode, run_node
from q2r2_control.ros.bridge.intakes import JointIntake, TargetIntake
from q2r2_control.ros.bridge.joint_outputs import NONE, make_output, output_name
from q2r2_control.ros.bridge.live_parameters import LiveStiffness
from q2r2_control.ros.bridge.messages import stamped_pose
from q2r2_control.ros.monitoring.endpoints import publish_in_time
from q2r2_control.supervision.external_arms import ExternalArms, ExternalSettings, settings_for_external_arms
from q2r2_control.supervision.joint_watch import watch_settings
from q2r2_control.supervision.supervisor import Displace, Phase, Supervisor
from q2r2_control.supervision.target_stream import Origins, StreamSettings
from q2r2_control.supervision.tick_pacer import TickPacer
from q2r2_control.types import LONGEST_DT, Reference

_LONGEST_STOP = 3.0  # [s]
_LOOK_PERIOD = 0.5  # between two looks at the graph [s]

_SAFE_TARGET_PERIOD = 0.008  # [s]
# Parameters that may change while the node runs: name, unit or meaning, least and greatest value.
_Table = tuple[tuple[str, str, str, float, float], ...]
_STREAM_PARAMETERS: _Table = (
    ("timeout", "target_timeout", "an arm without targets for this long holds [s]", 0.02, 2.0),
    ("engage_distance", "engage_distance", "targets have to begin this near to the tool [m]", 0.0, 0.2),
    ("engage_angle", "engage_angle", "and turned from it by no more [rad]", 0.0, 1.5),
)
_WATCH_PARAMETERS: _Table = (
    ("timeout", "joint_state_timeout", "without joint states for this long the arms brake [s]", 0.01, 1.0),
    ("settle_time", "settle_time", "joint states have to be good and at rest before activation [s]", 0.02, 10.0),
    ("deviation", "max_deviation", "of a joint from its reference [rad]", 0.01, 3.0),
    ("deviation_time", "deviation_time", "for this long stops the arms [s]", 0.05, 10.0),
)
_EXTERNAL_PARAMETERS: _Table = (
    ("tolerance", "distance_tolerance", "output none: measured pairs may be closer than min_distance [m]", 0.0, 0.1),
)


class CartesianControllerNode(BaseNode):
    """Feeds a :class:`Supervisor` from its topics and publishes the reference that comes of it."""

    ticks = True

    def __init__(self) -> None:
        super().__init__("cartesian_controller")
        config = load_config(self.parameter("config", "config/dual_iiwa7.yaml", "YAML of the cell"))
        rate = self.parameter("rate", 250.0, "of the control loop [Hz]", at_least=20, at_most=1000)
        output = output_name(self)
        if output == NONE:
            config = settings_for_external_arms(config)
        robot = Robot.from_config(config)
        self._period = 1.0 / rate
        self._output = make_output(output, self, robot, config, self._period)
        self._targets = TargetIntake(self, robot, self.report_health)
        self._joints = JointIntake(self, robot)
        streams, external = StreamSettings(), ExternalSettings()
        watch = watch_settings(config.supervision, self._output.drive.yields)
        # A message with a bad number among good ones is another publisher's: no reason to bridge it.
        watch.unusable_time = 0.0
        self._settings: dict[str, tuple[Any, str]] = {}
        self._declare(streams, _STREAM_PARAMETERS)
        self._declare(watch, _WATCH_PARAMETERS)
        self._declare(external, _EXTERNAL_PARAMETERS)
        self.add_post_set_parameters_callback(self._on_parameters)
        if isinstance(self._output.drive, TorqueDrive):
            self._stiffness = LiveStiffness(self, self._output.drive.impedance)
        self._controller = CartesianController(robot, permitted(config.control, self._output.drive))
        self._supervisor = Supervisor(
            robot,
            self._controller,
            streams,
            watch,
            Origins(self._joints.source, self._targets.source),
            ExternalArms(robot, self._controller, external, streams, watch) if output == NONE else None,
            displace=self._displacement(config) if output != NONE else None,
        )
        limit = robot.velocity_limit * config.control.velocity_scale
        acceleration = robot.capped_acceleration(config.control.acceleration_limit)
        self._pacer = TickPacer(self._period, limit, acceleration, self._output.drive.coasts)
        self._velocity = np.zeros(robot.model.nv)  # of the last reference [rad/s]
        self._reference: Reference | None = None
        self._commanding = False
        self._advances = 0
        # Another controller follows every one; arms that listen take a hundred a second.
        self._safe_target_ticks = 1 if output == NONE else max(round(_SAFE_TARGET_PERIOD * rate), 1)
        self._ticks, self._reported_at, self._last_tick = 0, time.monotonic(), self.now
        self._connect()
        self.get_logger().info(f"{config.name}: {', '.join(robot.arms)}; waits for joint states")

    def _displacement(self, config: Config) -> Displace | None:
        """The drive's own, where the cell has an admittance. Raises :class:`ConfigError` where nothing is measured."""
        if not config.admittance.enabled or self._output.drive.yields:
            return None
        if not self._joints.measures_external_torque:
            raise ConfigError("admittance.enabled = true: set the parameter external_torque_topic, which it needs")
        return self._output.drive.displaced

    def _declare(self, target: Any, table: _Table) -> None:
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

    def _connect(self) -> None:
        self._safe_targets = {
            arm: self.create_publisher(PoseStamped, f"~/safe_target/{arm}", SENT_COMMAND_QOS)
            for arm in self._targets.topics
        }
        self._follows: dict[str, bool | None] = dict.fromkeys(self._targets.topics)
        self._following = {arm: self.create_publisher(Bool, f"~/following/{arm}", LATCHED_QOS) for arm in self._follows}
        self._targets.subscribe(self._supervisor.take_target)
        self._joints.subscribe(self._supervisor.take_joint_state)
        self.create_service(SetBool, "~/pause", self._on_pause)
        services: dict[str, Callable[[], str | None]] = {
            "home": self._supervisor.go_home,
            "hold": self._supervisor.hold,
            "reset": self._supervisor.reset,
            "stop": self._stop,
        }
        for name, act in services.items():
            self.create_service(Trigger, f"~/{name}", partial(self._serve, act))
        self.create_timer(self._period, self._tick)
        # Looks even while /clock stands still.
        self.create_timer(_LOOK_PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _tick(self) -> None:
        decided = time.monotonic()
        if self._output.waits():
            return  # this tick is a missed one, and the next a late one
        now = self.now
        # A late tick is no jump; a clock that was set back moves nothing.
        gap = now - self._last_tick
        dt = self._pacer.step(gap, self._velocity)
        if gap > LONGEST_DT:
            self._supervisor.stalled(gap, now)
        self._last_tick = now
        self._ticks += 1
        if dt > 0.0:
            self._advance(now, dt, decided)
        self._tell_followed()

    def _advance(self, now: float, dt: float, decided: float) -> None:
        self._advances += 1
        # Commands that the arms do not follow are not for a receiver that has just come.
        if fault := self._output.listener_fault(self._supervisor.off_reference):
            self._supervisor.let_go(fault, now)
        was_active = self._supervisor.phase is Phase.ACTIVE
        reference, state = self._supervisor.tick(now, dt), self._joints.state
        if not was_active and self._supervisor.phase is Phase.ACTIVE and state is not None:
            self._output.activate(state)
        if reference is not None and state is not None:
            self._output.send(reference, state, dt, now, self._supervisor.trusted, decided)
            self._reference, self._velocity = reference, reference.v
            if self._advances % self._safe_target_ticks == 0:
                self._publish_safe_targets(now, decided)
        elif self._commanding and state is not None:
            self._output.end(state, now)
        self._commanding = reference is not None
        self._tell_events()

    def _publish_safe_targets(self, now: float, decided: float) -> None:
        for arm, publisher in self._safe_targets.items():
            if publisher.get_subscription_count():
                frame = self._targets.frames[arm]
                tool = frame.pose.actInv(self._controller.tool_pose(arm))
                publish_in_time(publisher, stamped_pose(tool, frame.name, now), decided)

    def _tell_followed(self) -> None:
        """Say of each arm whether its targets are followed, when that changes."""
        for arm, publisher in self._following.items():
            follows = self._supervisor.follows(arm)
            if follows != self._follows[arm]:
                self._follows[arm] = follows
                publisher.publish(Bool(data=follows))

    def _tell_events(self) -> None:
        if not self._supervisor.events:
            return
        for event in self._supervisor.events:
            self.get_logger().warning(event)
        self._supervisor.events.clear()
        self.report_health()

    def _look(self) -> None:
        """Remember who publishes what."""
        self._targets.look()
        self._joints.look()

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._supervisor.pause(request.data)
        self.report_health()  # arms that listen must not wait for the next time
        return _answer(response, None)

    def _serve(self, act: Callable[[], str | None], request: Any, response: Any) -> Any:
        refusal = act()
        self.report_health()
        return _answer(response, refusal)

    def _stop(self) -> str | None:
        self._supervisor.stop("stopped by ~/stop; ~/reset activates again")
        return None

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        supervisor, now, wall = self._supervisor, self.now, time.monotonic()
        values: dict[str, Any] = {
            "phase": supervisor.phase,
            "homing_ended": supervisor.homing_outcome or "",
            "loop_rate_hz": round(self._ticks / max(wall - self._reported_at, 1e-9), 1),
            "missed_ticks": self._pacer.missed_ticks,
        }
        self._ticks, self._reported_at = 0, wall
        for arm, rejected in self._targets.rejected.items():
            values[f"{arm}_state"] = "paused" if supervisor.paused else supervisor.arm_state(arm)
            age = supervisor.target_age(arm, now)
            values[f"{arm}_target_age_s"] = round(age, 3) if age < 1e6 else "none"
            values[f"{arm}_targets_rejected"] = rejected
            values[f"{arm}_targets_from"] = self._targets.publishers(arm)
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
        ended = self._supervisor.ended_targets
        if faults := self._targets.faults():
            return WARN, "; ".join(faults + ended)
        return OK, "; ".join(["paused" if self._supervisor.paused else "active", *ended])

    def close(self) -> None:
        """Bring the arms to rest along the certified stop before the commands end."""
        self._supervisor.stop("ending")
        deadline = last = time.monotonic()
        deadline += _LONGEST_STOP
        advances = self._advances
        try:
            while self._supervisor.phase is Phase.BRAKING and (now := time.monotonic()) < deadline:
                # Joint states still have to come in; the timer does the rest, unless simulated time has ended already.
                if self.executor is not None:
                    self.executor.spin_once(timeout_sec=self._period)
                if self._advances != advances:
                    advances, last = self._advances, now
                elif now - last > 2.0 * self._period:
                    self._advance(self.now, self._period, now)
        finally:
            if self._commanding and self._joints.state is not None:
                self._output.end(self._joints.state, self.now)


def _answer(response: Any, refusal: str | None) -> Any:
    response.success, response.message = refusal is None, refusal or "done"
    return response


def main() -> int:
    """The executable ``cartesian_controller``."""
    return run_node(CartesianControllerNode)


if __name__ == "__main__":
    sys.exit(main())
