"""``mujoco_robot``: the simulated cell as a ROS robot. It takes joint commands; Cartesian targets are a controller's.

Joint positions come in on any one of ``joint_trajectory`` (one point), ``joint_commands`` (JointState) and
``position_commands`` (Float64MultiArray in the order of the joints in ``joint_states``, all arms), velocities on
``velocity_commands`` and torques on ``torque_commands`` (the same order); the newest command counts. Without commands
the arms brake, and after ``hold_after`` they stand on their position servos, whatever drove them before.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.config.cell import load_config
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.plants.simulated_cell import SimulatedCell
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import LATCHED_QOS, OK, WARN
from q2r2_control.ros.bridge.frames import LinkFrames
from q2r2_control.ros.bridge.gripper_server import GripperServer, Stroke
from q2r2_control.ros.bridge.messages import age, delay, joint_state_message, seconds
from q2r2_control.ros.managed_node import ManagedNode
from q2r2_control.supervision.message_watch import DelayWatch
from q2r2_control.types import Array, RobotState

_LOG_PERIOD = 1.0  # of lines about refusals [s]
_TRAJECTORY = "joint_trajectory"
_STROKE = Stroke(open_position=0.0, closed_position=0.05)  # in goals, as Quest2ROS2 has them [m]


class MujocoRobot(ManagedNode):
    """Runs a :class:`SimulatedCell` in real time between its topics, services and actions."""

    ticks = True
    priority = 39

    def __init__(self) -> None:
        super().__init__("mujoco_robot")
        config = load_config(self.parameter("config", "config/dual_iiwa7.yaml", "YAML of the cell"))
        rate = self.parameter("rate", 250.0, "joint states per second [Hz]", within=(20, 1000))
        tf_rate = self.parameter("tf_rate", 50.0, "transforms per second [Hz]", within=(1, 1000))
        # Hands feel it fifty times a second; an admittance needs it in every tick.
        felt = rate if config.admittance.enabled else 50.0
        self._external_period = 1.0 / felt
        self._external_due = 0.0  # [s]
        hold_after = self.parameter("hold_after", 0.1, "without commands [s]", within=(0.01, 1))
        max_jump = self.parameter("max_jump", 0.1, "of a commanded position [rad]", within=(0.001, 7))
        self._robot = Robot.from_config(config)
        self._cell = SimulatedCell(self._robot, config, hold_after, max_jump)
        self._period = 1.0 / rate
        self._received = 0.0  # when the command that is being taken was [s]
        self._refused: dict[str, str] = {}
        self._refusals = 0
        self._delays: dict[tuple[str, ...], DelayWatch] = {}  # by topic and first joint
        self._make_publishers()
        self._make_subscriptions()
        self._grippers = {arm: self._gripper(arm) for arm in self._cell.plant.gripper_openings()}
        self.create_service(Trigger, "~/reset", self._reset)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # the simulation makes its own time, whatever /clock says
        self.create_tick(self._period, self._tick, clock=steady)
        self.create_tick(1.0 / tf_rate, self._publish_transforms, clock=steady)
        self.start_active()
        self.get_logger().info(f"{config.name}: {', '.join(self._robot.joint_names)}")

    def _make_publishers(self) -> None:
        self._joint_states = self.create_publisher(JointState, "joint_states", 10)
        self._measured_names = (*self._robot.joint_names, *self._cell.fingers)
        self._external = self.create_publisher(JointState, "~/external_torque", 10)
        self._tf = self.create_publisher(TFMessage, "/tf", 10)
        self._tf_static = self.create_publisher(TFMessage, "/tf_static", LATCHED_QOS)
        self._description = self.create_publisher(String, "robot_description", LATCHED_QOS)
        self._description.publish(String(data=self._robot.urdf))
        self._frames = LinkFrames(self._cell.plant.model, self._cell.loose_objects)
        self._tf_static.publish(self._frames.fixed.at(self._cell.plant.data, self.now))

    def _make_subscriptions(self) -> None:
        # Each arm may have a sender of its own, and the one's message is not to take the place of the other's.
        commands = QoSProfile(depth=2 * len(self._robot.arms), reliability=ReliabilityPolicy.RELIABLE)
        for kind, topic, callback in (
            (JointTrajectory, _TRAJECTORY, self._on_trajectory),
            (JointState, "joint_commands", self._on_joint_state),
            (Float64MultiArray, "position_commands", self._on_positions),
            (Float64MultiArray, "velocity_commands", self._on_velocities),
            (Float64MultiArray, "torque_commands", self._on_torques),
        ):
            self.create_subscription(kind, topic, partial(self._take, topic, callback), commands)

    def _gripper(self, arm: str) -> GripperServer:
        return GripperServer(
            self,
            f"/q2r2/{arm}_gripper/gripper_cmd",
            _STROKE,
            lambda opening: self._cell.command_gripper(arm, opening),
            lambda fault: self._note(f"{arm}_gripper", fault),
        )

    def _take(self, topic: str, callback: Callable[[Any], None], message: Any, info: Mapping[str, Any]) -> None:
        """Use a message now, or note why not."""
        if not self.is_active:
            self._note(topic, "the robot is deactivated; ros2 lifecycle set /cartesian_controller activate")
            return
        # Two controllers of an arm each may send on one topic, from hosts with clocks of their own.
        names = message.joint_names if topic == _TRAJECTORY else getattr(message, "name", ())
        delays = self._delays.setdefault((topic, *names[:1]), DelayWatch(STREAM_TIMEOUT))
        if late := delays.take(delay(info), time.monotonic()):
            self._note(topic, f"{late:.2f} s late; its sender or this node stood still")
            return
        # What came while this process stood still is as new as what came since the last tick.
        self._received = time.monotonic() - min(age(info), self._period)
        callback(message)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        points = message.points
        if len(points) != 1:
            self._note(_TRAJECTORY, f"{len(points)} points; allowed: one, a setpoint of a stream")
            return
        point = points[0]
        self._follow(_TRAJECTORY, message.joint_names, point.positions, point.velocities, point.time_from_start)

    def _on_joint_state(self, message: JointState) -> None:
        self._follow("joint_commands", message.name, message.position, message.velocity)

    def _on_positions(self, message: Float64MultiArray) -> None:
        self._follow("position_commands", self._robot.joint_names, message.data, ())

    def _on_velocities(self, message: Float64MultiArray) -> None:
        self._note("velocity_commands", self._cell.command_velocities(np.array(message.data, float), self._received))

    def _on_torques(self, message: Float64MultiArray) -> None:
        self._note("torque_commands", self._cell.command_torques(np.array(message.data, float), self._received))

    def _follow(self, topic: str, names: Any, positions: Any, velocities: Any, delay: Any = None) -> None:
        v = np.asarray(velocities, float) if len(velocities) else None
        q, due = np.asarray(positions, float), 0.0 if delay is None else seconds(delay)
        self._note(topic, self._cell.command_positions(names, q, v, self._received, due))

    def _note(self, topic: str, fault: str | None) -> None:
        """Say what was refused, until the topic brings something good again."""
        if fault is None:
            self._refused.pop(topic, None)
            return
        self._refusals += 1
        if topic not in self._refused:
            self._refused[topic] = fault
            line = f"{topic}: refused: {fault} ({self._refusals} refused so far)"
            self.get_logger().warning(line, throttle_duration_sec=_LOG_PERIOD)
            self.report_health()

    def _tick(self) -> None:
        cell, now = self._cell, time.monotonic()
        state = cell.advance(now)
        self.ticked += 1
        stamp = self.now
        self._publish_measured(state, stamp)
        if state.tau_external is not None and now >= self._external_due:
            # On a grid, half a tick early so that no tick of the grid is too early by its jitter.
            self._external_due = max(self._external_due + self._external_period, now - 0.5 * self._period)
            self._publish_external(state.tau_external, stamp)
        openings = cell.plant.gripper_openings()
        for arm, gripper in self._grippers.items():
            gripper.update(now, openings[arm], cell.gripper_force(arm))

    def _publish_external(self, torques: Array, stamp: float) -> None:
        if self._external.get_subscription_count():
            none = np.zeros(0)
            self._external.publish(joint_state_message(self._robot.joint_names, none, none, torques, stamp))

    def _publish_measured(self, state: RobotState, stamp: float) -> None:
        q = np.concatenate([state.q, self._cell.finger_positions()])
        v = np.concatenate([state.v, self._cell.finger_velocities()])
        tau = np.concatenate([state.tau, np.zeros(len(q) - len(state.tau))])  # fingers' efforts are not measured
        self._joint_states.publish(joint_state_message(self._measured_names, q, v, tau, stamp))

    def _publish_transforms(self) -> None:
        self._tf.publish(self._frames.moving.at(self._cell.plant.data, self.now))

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._cell.reset()
        response.success, response.message = True, "at home"
        return response

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        now = time.monotonic()
        mode = self._cell.mode(now)
        values = {
            "mode": mode,
            "lifecycle": self.lifecycle_state,
            "loop_rate_hz": self.tick_rate(),
            "time_dropped_s": round(self._cell.dropped, 3),
            "refused_commands": self._refusals,
        }
        if self._refused:
            return WARN, "; ".join(f"{topic}: refused: {fault}" for topic, fault in self._refused.items()), values
        if not self.is_active:
            return WARN, "deactivated: takes no commands; ros2 lifecycle set /cartesian_controller activate", values
        return OK, mode, values

    def begin(self) -> str | None:
        """Take commands again; the first has to be where the arms are, as any has."""
        self._refused.clear()
        return None

    def close(self) -> None:
        """Give the plant back."""
        self._cell.plant.close()
