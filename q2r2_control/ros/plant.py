"""``--plant ros``: a robot behind ROS 2, which sends joint states and gets setpoints from a loop in this process.

The loop replaces ``cartesian_controller``, and uses the same topics: ``joint_states``, ``joint_trajectory`` and the
actions of the grippers. The loop begins only if nobody else commands the arms.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable

import numpy as np
import rclpy
from rclpy.context import Context
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.config.cell import Config
from q2r2_control.config.external import GripperSettings
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.errors import PlantError
from q2r2_control.events import Reason
from q2r2_control.plants.base import check_command
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.gripper_client import GripperClient
from q2r2_control.ros.bridge.intakes import COMMAND_TIME, Fingers, JointIntake
from q2r2_control.ros.bridge.joint_outputs import TrajectoryOutput
from q2r2_control.ros.bridge.wire import JointNumbers
from q2r2_control.ros.commanders import CommandWatch
from q2r2_control.ros.executor import TickExecutor
from q2r2_control.ros.launch.middleware import set_up_middleware
from q2r2_control.ros.monitoring import WatchedPublisher
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.supervision.standstill import JOINTS
from q2r2_control.types import ArmTiming, Array, Command, CommandMode, RobotState
from q2r2_control.wording import sentence

_WAIT = 5.0  # Longest time to wait for joint states and for a receiver of the commands [s].
# Time for which the plant listens for other commanders before it commands, so that they can be discovered [s].
_QUIET = 1.0
_CURE = "; start the robot, and see q2r2 ros doctor"
# If a command is farther than this from the measured joints [rad], a new receiver would let the arms jump.
_AWAY = 0.02


class _PlantNode(BaseNode):
    ticks = True  # The messages of this node are taken when the loop ticks.


class RosPlant:
    """A plant whose arms start where they stand.

    The arms come to rest if joint states are missing or bad, if no node receives the commands, or if another node sends
    commands. They also come to rest if a further node begins to receive commands while the newest command is far from
    the measured joints.
    """

    modes: tuple[CommandMode, ...] = (CommandMode.POSITION,)
    realtime_only = True
    # The arms' controller is another process, which can freeze. Supervision uses these limits to notice this.
    standstill = JOINTS

    def __init__(self, robot: Robot, config: Config) -> None:
        self._robot, self._period = robot, 1.0 / config.nominal_rate_hz
        self._fingers, self._kind = Fingers(robot, config), TrajectoryOutput(self._period, robot)
        # Grippers count as open before a run, because no opening is measured yet.
        self._openings = dict.fromkeys(self._fingers.arms, 1.0)
        self._context: Context | None = None
        self._stopped: Callable[[], bool] = lambda: False  # Returns whether the wait for the robot should end.

    @classmethod
    def from_config(cls, robot: Robot, config: Config) -> RosPlant:
        return cls(robot, config)

    def begin(self, mode: CommandMode, stopped: Callable[[], bool]) -> None:
        """See :meth:`SessionPlant.begin`. There is only one mode."""
        self._stopped = stopped

    def reset(self, q: Array | None = None) -> None:
        """Begin to listen to the robot, and wait for its joint states and for a receiver of the commands.

        Raises:
            PlantError: If no joint states come or no node receives commands, if another node commands the robot, or if
                ``q`` is given.
        """
        if q is not None:
            raise PlantError("reset q: a real arm starts where it stands")
        self.close()
        set_up_middleware(os.environ)
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self._node = node = _PlantNode("q2r2_plant", context=self._context)
        self._executor = TickExecutor(context=self._context)
        self._executor.add_node(node)
        self._publisher = WatchedPublisher(node, JointTrajectory, TrajectoryOutput.topic, STREAM_TIMEOUT)
        self._grippers = {
            arm: GripperClient(node, node.full_name(f"q2r2/{arm}_gripper/gripper_cmd"), GripperSettings())
            for arm in self._fingers.arms
        }
        self._openings = {}
        self._joints = JointIntake(node, self._robot)
        self._bad: Reason | None = None  # Why the newest joint states are unusable; None if they are good.
        self._fault: Reason | None = None  # Why nothing is commanded; None if commands are sent.
        self._joints.subscribe(self._take_state, self._take_fingers)
        # Times of the computer's clock: when the newest joint states came, and when a receiver appeared [s].
        self._seen = self._received_since = -math.inf
        self._last = -math.inf  # Time of the last tick [s].
        self._command: Command | None = None  # The newest command.
        self._begins = True  # Whether the next command has to be at the arms' posture.
        self._others = others = CommandWatch(node, JointTrajectory, [self._publisher])
        others.begin()
        began = time.monotonic()
        while (waits := time.monotonic() - began) < _WAIT and not self._stopped():
            self._executor.spin_once(timeout_sec=0.01)
            if waits > _QUIET and self._joints.state is not None and self._publisher.listeners:
                break
        others.end()
        if problem := others.commander(_WAIT) or self._problem():
            self.close()
            raise PlantError(sentence(problem))
        self._listeners = self._publisher.listeners

    def _problem(self) -> Reason | None:
        if self._joints.state is None:
            return self._bad or Reason.of(SupervisionReason.NO_STATES_YET, source=_CURE)
        if not self._publisher.listeners:
            return Reason.of(RosReason.NO_SUBSCRIBER, topic=self._publisher.topic_name)
        if self._seen <= self._received_since:  # The newest state came before the present receiver appeared.
            return Reason.of(SupervisionReason.NO_STATES_YET, source=_CURE)
        return self._bad

    def _take_state(self, state: RobotState | Reason, now: float) -> None:
        self._bad, self._seen = (state if isinstance(state, Reason) else None), time.monotonic()

    def _take_fingers(self, message: JointState | JointNumbers) -> None:
        self._openings |= self._fingers.openings(message)

    def due(self, now: float) -> tuple[float, float]:
        """See :meth:`SessionPlant.due`. After a late tick the reference advances by two periods at most."""
        self._executor.spin_once(timeout_sec=0.0)
        gap, self._last = now - self._last, now
        before, self._listeners = self._listeners, self._publisher.listeners
        if self._listeners and not before:
            self._received_since = time.monotonic()
        new = self._listeners > before and self._command is not None and self._is_away(self._command)
        if self._begins:
            self._others.rest()
        other = self._others.commander() if self._begins else self._others.intruder()
        self._fault = Reason(RosReason.NEW_RECEIVER) if new else other or self._problem()
        return 0.0, min(gap, 2.0 * self._period)

    def _is_away(self, command: Command) -> bool:
        return bool(np.abs(self.state().q - command.q).max() > _AWAY)

    def withdraws(self) -> bool:
        return False

    def timings(self) -> dict[str, ArmTiming]:
        return self._joints.timings(self._last)

    def lead(self) -> float:
        """See :meth:`SessionPlant.lead`."""
        return self._period + COMMAND_TIME

    def delay(self) -> float:
        """Return 0, because drivers do not report their delay."""
        return 0.0

    def fault(self) -> Reason | None:
        return self._fault

    def sessions(self) -> dict[str, str]:
        return {}

    def apply(self, command: Command) -> None:
        check_command(command, self._robot, self.modes)
        self._begins = self._fault is not None or (self._begins and self._is_away(command))
        if self._begins:
            return
        decided, self._command = time.monotonic(), command
        names, joints = list(self._robot.joint_names), np.arange(self._robot.model.nv)
        self._publisher.publish(self._kind.encode(command, self.state(), decided, names, joints), decided)
        for arm, gripper in self._grippers.items():
            if arm in command.grippers:
                gripper.move(float(command.grippers[arm]), decided)
                gripper.check(decided)

    def advance(self, dt: float) -> None:
        """Do nothing, because the time of real arms passes by itself."""

    def state(self) -> RobotState:
        state = self._joints.state
        assert state is not None  # ``reset`` has waited for the first state.
        return state

    def gripper_openings(self) -> dict[str, float]:
        return dict(self._openings)

    def close(self) -> None:
        if self._context is not None:
            self._executor.shutdown()
            self._node.destroy_node()
            self._context.try_shutdown()
            self._context = None
