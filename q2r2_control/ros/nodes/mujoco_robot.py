"""``mujoco_robot``: the simulated cell as a ROS robot. It takes joint commands. Cartesian targets need a controller.

Joint positions come in on any one of ``joint_trajectory`` (one point), ``joint_commands`` (JointState) and
``position_commands`` (Float64MultiArray in the order of the joints in ``joint_states``, all arms). Velocities come in
on ``velocity_commands`` and torques on ``torque_commands``, in the same order. The newest command counts. Without
commands the arms brake, and after ``hold_after`` their position servos hold them, after any kind of commands.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from control_msgs.action import GripperCommand
from geometry_msgs.msg import TransformStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.serde import SerdeError
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.plants.simulated_cell import SimulatedCell
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import LATCHED_QOS, OK, STEADY, WARN, BaseNode
from q2r2_control.ros.bridge.messages import age, delay, joint_state_template, seconds
from q2r2_control.ros.bridge.wire import Template, trajectory_reader
from q2r2_control.supervision.targets import DelayWatch

_LOG_PERIOD = 1.0  # Least time between lines about refusals [s].
_TRAJECTORY = "joint_trajectory"
_REACHED = 0.02  # Distance from the goal that counts as reached, as a share of the stroke.
_STALLED_AFTER = 0.3  # A gripper that does not move by _MOVES within this time has stalled [s].
_MOVES = 0.004  # Least motion of a gripper that counts, as a share of the stroke.
_OUTSIDE = 0.02  # A goal that exceeds the stroke by at most this share of the stroke counts as the end of the stroke.
_CLOSED = 0.05  # Closed position in goals, as in Quest2ROS2; 0 is fully open [m].
# The parts x y z w of the product of two unit quaternions, the first of which is inverted. Each part is a sum over the
# products of the parts w x y z of both, with these factors.
_INVERSE_TIMES = np.array(
    [
        [[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -1.0], [0.0, 0.0, 1.0, 0.0]],
        [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]],
        [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]],
        np.eye(4),
    ]
)


@dataclass(slots=True)
class _Motion:
    handle: ServerGoalHandle
    goal: float  # Opening: 0 closed .. 1 open.
    seen: float  # Opening when the gripper last moved.
    moved_at: float  # Time at which the gripper last moved [s].


class GripperServer:
    """Serves the action ``topic`` of a gripper. A new goal aborts the previous goal.

    If the fingers stop on an object, the goal has succeeded, and its result says ``stalled``.

    The ``max_effort`` of a goal is not used. :meth:`update` processes goals, because a waiting callback would block the
    node.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        measure: Callable[[], tuple[float, float]],
        command: Callable[[float], None],
        refuse: Callable[[str], None],
    ) -> None:
        """Make the server.

        Args:
            node: The node that offers the action.
            topic: The name of the action.
            measure: Returns the gripper's opening, from 0 closed to 1 open, and its effort [N].
            command: Takes the opening to which the gripper has to move.
            refuse: Takes one line that says why a goal is refused.
        """
        self._measure, self._command, self._refuse = measure, command, refuse
        self._motion: _Motion | None = None
        self._newest: ServerGoalHandle | None = None
        self.server = ActionServer(
            node,
            GripperCommand,
            topic,
            # This result is not used, because each goal gets its own result at its end.
            execute_callback=lambda _: GripperCommand.Result(),
            goal_callback=self._check,
            handle_accepted_callback=self._accept,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def update(self, now: float) -> None:
        """Continue with the goal, if there is one, at ``now`` [s]."""
        if self._newest is None and self._motion is None:
            return
        opening, effort = self._measure()
        position = _CLOSED * (1.0 - opening)
        if self._newest is not None:
            if self._motion is not None:
                self._end(self._motion.handle, "abort", GripperCommand.Result(position=position, effort=effort))
            goal = 1.0 - self._newest.request.command.position / _CLOSED
            self._motion = _Motion(self._newest, min(max(goal, 0.0), 1.0), opening, now)
            self._newest = None
            self._command(self._motion.goal)
        motion = self._motion
        assert motion is not None
        if abs(opening - motion.seen) > _MOVES:
            motion.seen, motion.moved_at = opening, now
        reached = abs(opening - motion.goal) <= _REACHED
        stalled = not reached and now - motion.moved_at > _STALLED_AFTER
        if motion.handle.is_cancel_requested:
            self._command(opening)
        elif not (reached or stalled):
            motion.handle.publish_feedback(GripperCommand.Feedback(position=position, effort=effort))
            return
        told = GripperCommand.Result(position=position, effort=effort, reached_goal=reached, stalled=stalled)
        self._end(motion.handle, "succeed", told)
        self._motion = None

    def _check(self, goal: GripperCommand.Goal) -> GoalResponse:
        position = goal.command.position
        if -_OUTSIDE <= position / _CLOSED <= 1.0 + _OUTSIDE:  # NaN is refused too.
            return GoalResponse.ACCEPT
        self._refuse(f"gripper position {position:g} m; allowed: 0 .. {_CLOSED:g}")
        return GoalResponse.REJECT

    def _accept(self, handle: ServerGoalHandle) -> None:
        if self._newest is not None:
            self._end(self._newest, "abort", GripperCommand.Result())
        self._newest = handle

    def _end(self, handle: ServerGoalHandle, outcome: str, result: GripperCommand.Result) -> None:
        def conclude(handle: ServerGoalHandle) -> GripperCommand.Result:
            # A goal with a requested cancellation can only end as canceled.
            getattr(handle, "canceled" if handle.is_cancel_requested else outcome)()
            return result

        handle.execute(conclude)


class MujocoRobot(BaseNode):
    """Runs a :class:`SimulatedCell` in real time, and connects it to topics, services and actions."""

    ticks = True

    def __init__(self) -> None:
        super().__init__("mujoco_robot")
        config = load_config(self.parameter("config", "config/dual_iiwa7.yaml", "YAML of the cell"))
        rate = self.parameter("rate", 250.0, "joint states per second [Hz]", within=(20, 1000))
        tf_rate = self.parameter("tf_rate", 50.0, "transforms per second [Hz]", within=(1, 1000))
        # Vibrations need external torques fifty times a second, and an admittance needs them at every tick.
        felt = rate if config.admittance.enabled else 50.0
        self._external_period, self._external_due = 1.0 / felt, 0.0  # Period and next time of external torques [s].
        hold_after = self.parameter("hold_after", 0.1, "without commands [s]", within=(0.01, 1))
        max_jump = self.parameter("max_jump", 0.1, "of a commanded position [rad]", within=(0.001, 7))
        self._robot = Robot.from_config(config)
        self._cell = SimulatedCell(self._robot, config, hold_after, max_jump)
        self._period = 1.0 / rate
        self._received = 0.0  # Receipt time of the command that is being processed [s].
        self._refused: dict[str, str] = {}
        self._refusals = 0
        self._delays: dict[tuple[str, ...], DelayWatch] = {}  # The delays of commands, by topic and first joint.
        self._make_publishers()
        self._make_subscriptions()
        self._grippers = {
            arm: GripperServer(
                self,
                f"q2r2/{arm}_gripper/gripper_cmd",
                partial(self._cell.gripper_state, arm),
                partial(self._cell.command_gripper, arm),
                partial(self._note, f"{arm}_gripper"),
            )
            for arm in self._cell.plant.gripper_openings()
        }
        self.create_service(Trigger, "~/reset", self._reset)
        # The simulation has its own time, and ignores /clock.
        self.create_tick(self._period, self._tick, clock=STEADY)
        self.create_tick(1.0 / tf_rate, self._publish_transforms, clock=STEADY)
        self.get_logger().info(f"{config.name}: {', '.join(self._robot.joint_names)}")

    def _make_publishers(self) -> None:
        self._joint_states = self.create_publisher(JointState, "joint_states", 10)
        self._measured = joint_state_template((*self._robot.joint_names, *self._cell.fingers))
        self._felt = joint_state_template(self._robot.joint_names, q=False, v=False)
        self._external = self.create_publisher(JointState, "~/external_torque", 10)
        self._tf = self.create_publisher(TFMessage, "tf", 10)
        self._tf_static = self.create_publisher(TFMessage, "tf_static", LATCHED_QOS)
        self._description = self.create_publisher(String, "robot_description", LATCHED_QOS)
        self._description.publish(String(data=self._robot.urdf))
        self._moving, fixed = link_transforms(self._cell.plant.model, self._cell.loose_objects)
        self._tf_static.publish(fixed.at(self._cell.plant.data, self.now))

    def _make_subscriptions(self) -> None:
        # The queue has two messages per arm. Each arm can have its own sender, and one sender's message must not
        # replace the other sender's message.
        commands = QoSProfile(depth=2 * len(self._robot.arms), reliability=ReliabilityPolicy.RELIABLE)
        names, move, push = self._robot.joint_names, self._cell.command_velocities, self._cell.command_torques
        kinds: tuple[tuple[type, str, Callable[[Any], str | None]], ...] = (
            (JointTrajectory, _TRAJECTORY, self._follow_trajectory),
            (JointState, "joint_commands", lambda m: self._follow(m.name, m.position, m.velocity)),
            (Float64MultiArray, "position_commands", lambda m: self._follow(names, m.data, ())),
            (Float64MultiArray, "velocity_commands", lambda m: move(np.array(m.data), self._received)),
            (Float64MultiArray, "torque_commands", lambda m: push(np.array(m.data), self._received)),
        )
        for kind, topic, command in kinds:
            take = partial(self._take, topic, command)
            # These messages are read without rclpy's conversion, because they come at every tick.
            if kind is JointTrajectory:
                take = partial(self._take_serialized, trajectory_reader(), take)
            self.create_subscription(kind, topic, take, commands, raw=kind is JointTrajectory)

    def _take_serialized(
        self, read: Callable[[bytes], Any], take: Callable[[Any, Any], None], data: bytes, info: Mapping[str, Any]
    ) -> None:
        try:
            message = read(data)
        except SerdeError:  # The bytes are no valid message. This is a fault of the sender.
            self.drop(_TRAJECTORY, f"{len(data)} bytes")
            return
        take(message, info)

    def _take(self, topic: str, command: Callable[[Any], str | None], message: Any, info: Mapping[str, Any]) -> None:
        # Delays are watched separately for each topic and each first joint, because two controllers, each for one arm,
        # can send on the same topic from hosts with different clocks.
        names = message.joint_names if topic == _TRAJECTORY else getattr(message, "name", ())
        delays = self._delays.setdefault((topic, *names[:1]), DelayWatch(STREAM_TIMEOUT))
        if late := delays.take(delay(info), time.monotonic()):
            self._note(topic, f"{late:.2f} s late; its sender or this node stood still")
            return
        # A message that came while this process stood still counts as if it had come since the last tick.
        self._received = time.monotonic() - min(age(info), self._period)
        self._note(topic, command(message))

    def _follow_trajectory(self, message: JointTrajectory) -> str | None:
        if len(message.points) != 1:
            return f"{len(message.points)} points; allowed: one, a setpoint of a stream"
        point = message.points[0]
        return self._follow(message.joint_names, point.positions, point.velocities, seconds(point.time_from_start))

    def _follow(self, names: Any, positions: Any, velocities: Any, delay: float = 0.0) -> str | None:
        v = np.asarray(velocities, float) if len(velocities) else None
        return self._cell.command_positions(names, np.asarray(positions, float), v, self._received, delay)

    def _note(self, topic: str, fault: str | None) -> None:
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
        q = state.q.tolist() + cell.finger_positions().tolist()
        v = state.v.tolist() + cell.finger_velocities().tolist()
        # Fingers get the effort 0, because it is not measured.
        tau = state.tau.tolist() + [0.0] * len(cell.fingers)
        self._joint_states.publish(self._measured.fill(q + v + tau, stamp))
        if state.tau_external is not None and now >= self._external_due:
            # Each due time is half a tick before the regular time, so that a tick that comes slightly early publishes.
            self._external_due = max(self._external_due + self._external_period, now - 0.5 * self._period)
            if self._external.get_subscription_count():
                self._external.publish(self._felt.fill(state.tau_external.tolist(), stamp))
        for gripper in self._grippers.values():
            gripper.update(now)

    def _publish_transforms(self) -> None:
        self._tf.publish(self._moving.at(self._cell.plant.data, self.now))

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._cell.reset()
        response.success, response.message = True, "at home"
        return response

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        mode = self._cell.mode(time.monotonic())
        values = {
            "mode": mode,
            "loop_rate_hz": self.tick_rate(),
            "time_dropped_s": round(self._cell.dropped, 3),
            "refused_commands": self._refusals,
        }
        if self._refused:
            return WARN, "; ".join(f"{topic}: refused: {fault}" for topic, fault in self._refused.items()), values
        return OK, mode, values

    def close(self) -> None:
        self._cell.plant.close()


def link_transforms(model: Any, without: Collection[str]) -> tuple[LinkTransforms, LinkTransforms]:
    """Return the transforms of the links that a joint moves, and the transforms of all other links.

    Bodies that are named in ``without`` are left out.
    """
    links = [index for index in range(1, model.nbody) if model.body(index).name not in without]
    moving = [index for index in links if model.body_jntnum[index]]
    return LinkTransforms(model, moving), LinkTransforms(model, [index for index in links if index not in moving])


class LinkTransforms:
    """The poses of bodies in their parents, as a serialized TFMessage."""

    def __init__(self, model: Any, bodies: list[int]) -> None:
        self._bodies, self._parents = np.array(bodies, dtype=int), model.body_parentid[bodies]

        def make(numbers: Iterator[float], stamp: Any) -> TFMessage:
            message = TFMessage()
            for body, parent in zip(bodies, self._parents.tolist(), strict=True):
                transform = TransformStamped(child_frame_id=model.body(body).name)
                transform.header.frame_id, transform.header.stamp = model.body(parent).name, stamp
                p, o = transform.transform.translation, transform.transform.rotation
                p.x, p.y, p.z, o.x, o.y, o.z, o.w = islice(numbers, 7)
                message.transforms.append(transform)
            return message

        self._template = Template(make, Time())

    def at(self, data: Any, t: float) -> bytes:
        """Return the message for a ``mujoco.MjData`` at ``t`` [s]."""
        away = data.xpos[self._bodies] - data.xpos[self._parents]
        numbers = np.empty((len(self._bodies), 7))
        numbers[:, :3] = np.einsum("nij,ni->nj", data.xmat.reshape(-1, 3, 3)[self._parents], away)
        turned, its = data.xquat[self._parents], data.xquat[self._bodies]
        numbers[:, 3:] = np.einsum("kij,ni,nj->nk", _INVERSE_TIMES, turned, its)
        return self._template.fill(numbers.ravel().tolist(), t)
