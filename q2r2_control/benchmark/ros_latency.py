"""``q2r2 bench --ros``: the latency from an input topic to the joint command that answers it.

Runs real processes on this machine, in a ROS domain that nothing else uses: the simulated robot, the controller, and
one arm's teleoperation. The input steps up and down by millimetres at random times; :mod:`command_responses` finds the
commands that answer.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from quest2ros.msg import OVR2ROSInputs
from rclpy.executors import SingleThreadedExecutor
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.benchmark.command_responses import CommandRecording, LatencyReport, latency_report
from q2r2_control.benchmark.ros_processes import private_domain, started
from q2r2_control.config.cell import load_config
from q2r2_control.errors import Q2R2Error
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import COMMAND_QOS, STREAM_QOS
from q2r2_control.ros.launch.processes import NodeProcess

_START_TIMEOUT = 300.0  # kernels may have to be compiled [s]
_STEP = 0.002  # [m]
_PAUSES = 0.07, 0.11  # between two steps; shorter than any timeout of a stream [s]
_PRESS, _CHORD = 0.3, 0.3  # the lower button is held, and what follows its release [s]
# The shortest delays that the hand's filters allow, so that mostly the nodes are measured.
_SHORTEST_FILTER = {"interpolation_delay": 0.005, "smoothing_delay": 0.0, "min_cutoff": 100.0, "beta": 1000.0}


class LatencyError(Q2R2Error):
    """A node did not start in time; the message says what was waited for."""


def measure_latency(config: str, duration: float, rate: float, progress: Callable[[str], None]) -> LatencyReport:
    """Measure for ``duration`` [s] each way, with the controller at ``rate`` [Hz]. Raises :class:`LatencyError`."""
    cell = load_config(config)
    limit = Robot.from_config(cell).capped_acceleration(cell.control.acceleration_limit)
    filters = {f"teleop.filter.{name}": value for name, value in _SHORTEST_FILTER.items()}
    nodes = [
        NodeProcess("mujoco_robot", "q2r2_control.ros.nodes.mujoco_robot", {"config": config}),
        NodeProcess(
            "cartesian_controller",
            "q2r2_control.ros.nodes.cartesian_controller",
            {"config": config, "rate": float(rate)},
        ),
    ]
    arm = NodeProcess("left_arm_controller", "q2r2_control.ros.nodes.left_arm_controller", filters)
    with private_domain(), started(nodes), _Probe() as probe:
        progress("waiting for the controller")
        probe.wait_for_tool()
        progress(f"target topic to joint command: {duration:g} s")
        target = probe.step_targets(duration)
        with started([arm]):
            progress("waiting for the arm's teleoperation")
            probe.engage_hand()
            progress(f"hand topic to joint command: {duration:g} s")
            hand = probe.step_hand(duration)
    return latency_report(rate, limit, {"target to joint command": target, "hand to joint command": hand})


class _Probe:
    """Publishes steps and records commands. Their times are the middleware's, so a late callback changes none."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("latency_probe", context=self._context)
        self._commands: list[tuple[float, float, list[float]]] = []
        self._tool: PoseStamped | None = None
        listen: Any = self._on_command  # rclpy's types know callbacks without the message's stamps only
        self._node.create_subscription(JointTrajectory, "/joint_trajectory", listen, 1000)
        self._node.create_subscription(PoseStamped, "/cartesian_controller/safe_target/left", self._on_tool, 1)
        self._target = self._node.create_publisher(PoseStamped, "/q2r2/left/target_frame", COMMAND_QOS)
        self._hand = self._node.create_publisher(PoseStamped, "/q2r_left_hand_pose", STREAM_QOS)
        self._inputs = self._node.create_publisher(OVR2ROSInputs, "/q2r_left_hand_inputs", STREAM_QOS)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    def __enter__(self) -> _Probe:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def wait_for_tool(self) -> None:
        """Wait until the controller is active, has published the tool's pose, and subscribes to targets."""
        self._wait(lambda: self._tool is not None and self._commands, "cartesian_controller's commands")
        self._wait(lambda: self._target.get_subscription_count() > 0, "cartesian_controller's subscription")

    def step_targets(self, duration: float) -> CommandRecording:
        """Step the target up and down at the tool."""
        assert self._tool is not None
        recording = self._step(self._target, self._tool, duration, lambda: None)
        self._node.destroy_publisher(self._target)  # the next one is the arm controller's
        return recording

    def engage_hand(self) -> None:
        """Press the lower button until the arm's node publishes targets, and goes on.

        A press that is answered late may meet the next one, which pauses the arm again: so what follows is asked after
        the buttons rest, and not of what came while they were pressed.
        """
        targets: list[PoseStamped] = []
        subscription = self._node.create_subscription(PoseStamped, "/q2r2/left/target_frame", targets.append, 1)
        deadline = time.monotonic() + _START_TIMEOUT
        while not targets:
            if time.monotonic() > deadline:
                raise LatencyError(f"left_arm_controller was not engaged within {_START_TIMEOUT:g} s")
            for pressed, period in ((True, _PRESS), (False, _CHORD)):
                self._send_hand(pressed, period)
            targets.clear()
            self._send_hand(False, _CHORD)
        self._node.destroy_subscription(subscription)

    def step_hand(self, duration: float) -> CommandRecording:
        """Step the hand's pose."""
        return self._step(self._hand, _pose(), duration, lambda: self._inputs.publish(OVR2ROSInputs()))

    def _step(
        self, publisher: Any, begin: PoseStamped, duration: float, beside: Callable[[], None]
    ) -> CommandRecording:
        random, message = np.random.default_rng(0), begin
        height = message.pose.position.z
        self._commands.clear()
        steps: list[float] = []
        end = time.monotonic() + duration
        while time.monotonic() < end:
            beside()
            message.pose.position.z = height + _STEP * (len(steps) % 2)
            steps.append(time.time())  # the clock of the middleware's stamps
            publisher.publish(message)
            self._spin(random.uniform(*_PAUSES))
        if not self._commands:
            raise LatencyError(f"no joint command came within {duration:g} s")
        sent, received, v = (list(column) for column in zip(*self._commands, strict=True))
        return CommandRecording(steps, sent, received, np.array(v))

    def _send_hand(self, pressed: bool, period: float) -> None:
        end = time.monotonic() + period
        while time.monotonic() < end:
            self._hand.publish(_pose())
            self._inputs.publish(OVR2ROSInputs(button_lower=pressed))
            self._spin(0.02)

    def _wait(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + _START_TIMEOUT
        while not condition():
            if time.monotonic() > deadline:
                raise LatencyError(f"waited {_START_TIMEOUT:g} s for {what}")
            self._spin(0.05)

    def _spin(self, period: float) -> None:
        end = time.monotonic() + period
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(left)

    def _on_command(self, message: JointTrajectory, info: dict[str, int]) -> None:
        stamps = (1e-9 * info["source_timestamp"], 1e-9 * info["received_timestamp"])
        self._commands.append((*stamps, list(message.points[0].velocities)))

    def _on_tool(self, message: PoseStamped) -> None:
        self._tool = message


def _pose() -> PoseStamped:
    message = PoseStamped()
    message.pose.orientation.w = 1.0
    return message
