"""How long does it take from a message on an input topic to the joint command that answers it, through real nodes?

The simulated robot, the controller, and the teleoperation of one arm run as real processes on this machine. They have a
ROS domain of their own. The input steps up and down by millimetres at random times. The answer to a step is the first
command after it that has a high acceleration. Without a new step, no command has such an acceleration.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import rclpy
import typer
from geometry_msgs.msg import PoseStamped
from quest2ros.msg import OVR2ROSInputs
from rclpy.executors import SingleThreadedExecutor
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import Q2R2Error
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import COMMAND_QOS, STREAM_QOS
from q2r2_control.ros.launch.processes import NodeProcess
from q2r2_control.types import Array
from q2r2_control.viewer.tables import figure_table
from ros_processes import private_domain, started

_START_TIMEOUT_S = 300.0  # Timeout for the nodes, which may have to compile kernels first [s].
_STEP_SIZE = 0.002  # Size of a step [m].
_STEP_PAUSES_S = 0.07, 0.11  # Shortest and longest time between two steps, below any timeout of a stream [s].
_PRESS_S, _AFTER_PRESS_S = 0.3, 0.3  # Duration of a press of the lower button, and waiting time after its release [s].
# Settings with the shortest delays that the hand's filters allow, so that mostly the nodes are measured.
_SHORTEST_FILTER = {"interpolation_delay": 0.005, "smoothing_delay": 0.0, "min_cutoff": 100.0, "beta": 1000.0}


# A command with more than this share of the acceleration limit is an answer. A step causes an acceleration at the whole
# limit. At that time, the motion that the previous step has caused needs only a tenth of the limit.
_ANSWER_SHARE = 0.4


@dataclass(frozen=True, slots=True)
class CommandRecording:
    """The steps of one input and the joint commands meanwhile. Times are ascending and come from one clock [s]."""

    steps: Sequence[float]  # Time when each step was published.
    sent: Sequence[float]  # Time when each command was published, from the middleware's stamps.
    received: Sequence[float]  # Time when each command was received, from the middleware's stamps.
    v: Array  # Velocities of the commands (n, nv) [rad/s].


@dataclass(frozen=True, slots=True)
class LatencyRow:
    """The latencies of one input, from the step until the command was received. None if no step was answered."""

    path: str  # Names of the first and the last topic.
    steps: int  # Number of steps.
    missed: int  # Number of steps that were not answered before the next step.
    p50_ms: float | None
    p99_ms: float | None
    max_ms: float | None


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """The measured latencies of all inputs."""

    loop_rate_hz: float  # Configured loop rate of the controller.
    transport_p50_ms: float  # Median time that a joint command takes between two processes. All rows include it.
    transport_p99_ms: float  # 99th percentile of the time that a joint command takes between two processes.
    rows: tuple[LatencyRow, ...]


class LatencyError(Q2R2Error):
    """An error of a node that did not start in time. The message says what was waited for."""


def measure_latency(config: str, duration: float, rate: float) -> LatencyReport:
    """Measure each input for ``duration`` [s], with the controller at ``rate`` [Hz].

    Raises :class:`LatencyError` if a node does not start in time.
    """
    cell = load_config(config)
    limit = Robot.from_config(cell).capped_acceleration(cell.control.acceleration_limit)
    filters = {f"teleop.filter.{name}": value for name, value in _SHORTEST_FILTER.items()}
    nodes = [
        NodeProcess("mujoco_robot", {"config": config}),
        NodeProcess("cartesian_controller", {"config": config, "rate": float(rate)}),
    ]
    arm = NodeProcess("left_arm_controller", filters)
    with private_domain(), started(nodes), _Probe() as probe:
        print_progress("Waiting for the controller.")
        probe.wait_for_tool()
        print_progress(f"target topic to joint command: {duration:g} s")
        target = probe.step_targets(duration)
        with started([arm]):
            print_progress("Waiting for the arm's teleoperation.")
            probe.engage_hand()
            print_progress(f"hand topic to joint command: {duration:g} s")
            hand = probe.step_hand(duration)
    return latency_report(rate, limit, {"target to joint command": target, "hand to joint command": hand})


class _Probe:
    """A node that publishes steps and records commands.

    The times of commands are the stamps of the middleware, so they do not depend on when a callback runs.
    """

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("latency_probe", context=self._context)
        self._commands: list[tuple[float, float, list[float]]] = []
        self._tool: PoseStamped | None = None
        # ``listen`` has the type Any, because rclpy's type hints lack callbacks that get the message's stamps.
        listen: Any = self._on_command
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
        """Step the target up and down at the tool's pose."""
        assert self._tool is not None
        recording = self._step(self._target, self._tool, duration, lambda: None)
        self._node.destroy_publisher(self._target)  # The arm's node publishes the targets from now on.
        return recording

    def engage_hand(self) -> None:
        """Press the lower button until the arm's node keeps publishing targets.

        If the node answers a press late, the next press can already pause the arm again. Therefore this method counts
        only targets that come after the button was released. Targets that come during a press do not count.
        """
        targets: list[PoseStamped] = []
        subscription = self._node.create_subscription(PoseStamped, "/q2r2/left/target_frame", targets.append, 1)
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not targets:
            if time.monotonic() > deadline:
                raise LatencyError(f"left_arm_controller was not engaged within {_START_TIMEOUT_S:g} s")
            for pressed, period in ((True, _PRESS_S), (False, _AFTER_PRESS_S)):
                self._send_hand(pressed, period)
            targets.clear()
            self._send_hand(False, _AFTER_PRESS_S)
        self._node.destroy_subscription(subscription)

    def step_hand(self, duration: float) -> CommandRecording:
        """Step the hand's pose up and down."""
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
            message.pose.position.z = height + _STEP_SIZE * (len(steps) % 2)
            steps.append(time.time())  # The middleware's stamps are times of this clock too.
            publisher.publish(message)
            self._spin(random.uniform(*_STEP_PAUSES_S))
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
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not condition():
            if time.monotonic() > deadline:
                raise LatencyError(f"waited {_START_TIMEOUT_S:g} s for {what}")
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


def latency_report(rate: float, acceleration_limit: Array, recordings: Mapping[str, CommandRecording]) -> LatencyReport:
    """Return the latencies of each path.

    The controller runs at ``rate`` [Hz] and has the ``acceleration_limit`` (nv,) [rad/s^2].
    """
    transport = 1e3 * np.concatenate(
        [np.subtract(recording.received, recording.sent) for recording in recordings.values()]
    )
    median, tail = np.percentile(transport, [50.0, 99.0]).tolist()
    return LatencyReport(
        rate, median, tail, tuple(_row(path, recording, acceleration_limit) for path, recording in recordings.items())
    )


def _row(path: str, recording: CommandRecording, acceleration_limit: Array) -> LatencyRow:
    """Find the answer to each step, as the module's docstring defines it, and return the latencies."""
    times = np.asarray(recording.sent)
    # Ticks may be early or late, so each change of velocity is divided by the real time between its two commands. This
    # time counts as at least half of the median time, because a very short time would give a high acceleration.
    dt = np.diff(times)
    change = np.abs(np.diff(recording.v, axis=0) / acceleration_limit).max(axis=1)
    answering = np.concatenate([[False], change > _ANSWER_SHARE * np.maximum(dt, 0.5 * np.median(dt))])
    latencies = []
    # The last step is left out, because the recording ends before its answer.
    for step, following in zip(recording.steps[:-1], recording.steps[1:], strict=True):
        first, last = np.searchsorted(times, [step, following])
        if len(found := np.flatnonzero(answering[first:last])):
            latencies.append(1e3 * (recording.received[first + found[0]] - step))
    counted = len(recording.steps) - 1
    percentiles = np.percentile(latencies, [50.0, 99.0, 100.0]).tolist() if latencies else (None, None, None)
    return LatencyRow(path, counted, counted - len(latencies), *percentiles)


def main(
    duration: Annotated[float, typer.Option(min=1, max=3600, help="Duration for each input [s].")] = 30.0,
    rate: Annotated[float, typer.Option(min=20, max=1000, help="Rate of the controller's node [Hz].")] = 250.0,
    json: Json = False,
) -> None:
    """Print the latencies from an input topic to the joint command that answers it."""
    report = measure_latency(DEMO_CONFIG, duration, rate)
    table = figure_table(
        f"Latency from an input topic to the joint command that answers it, controller at {rate:g} Hz",
        ("path", "p50 [ms]", "p99 [ms]", "max [ms]", "steps", "missed"),
        ((row.path, row.p50_ms, row.p99_ms, row.max_ms, row.steps, row.missed) for row in report.rows),
        (
            f"A joint command alone takes {report.transport_p50_ms:.2f} ms between two processes in the median, and "
            f"{report.transport_p99_ms:.2f} ms at the 99th percentile.",
            "The hand's latency includes an interpolation of 5 ms, which is the shortest one. Its filters are off.",
        ),
    )
    print_report(report, (table,), json)


if __name__ == "__main__":
    typer.run(main)
