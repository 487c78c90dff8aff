"""How much processor time do the nodes of ``q2r2 ros up`` need, and how even is the motion of their commands?"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
import rclpy
import typer
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import Q2R2Error
from q2r2_control.ros.executor import TickExecutor, TickGroup
from q2r2_control.ros.launch.processes import NodeProcess, nodes_of
from q2r2_control.types import Array
from q2r2_control.viewer.tables import figure_table
from ros_processes import private_domain, processor_time, started

_START_TIMEOUT_S = 300.0  # Timeout for the nodes, which may have to compile kernels first [s].
_SETTLING_S = 3.0  # Time to wait after the nodes have started, and again after the hands have started [s].
_SAMPLE_JITTER_S = 0.002  # Largest random delay of a headset's sample [s].
_TREND_WINDOW_S = 0.15  # Width of the window that separates the hand's own slow motion from faster ripple [s].
_NODES_WITH_RATE = "mujoco_robot", "cartesian_controller"  # Nodes that run at the rate of the command line.
_SCRIPTED_HANDS = NodeProcess("SimulationInput", {"jitter": _SAMPLE_JITTER_S})


@dataclass(frozen=True, slots=True)
class NodeLoad:
    """The processor time of one node, in percent of one core."""

    node: str
    idle: float  # Load while all nodes run and no arm is engaged.
    moving: float  # Load while both arms follow circles.


@dataclass(frozen=True, slots=True)
class LoadReport:
    """The measured figures of all nodes."""

    seconds: float  # Duration of each of the two measurements [s].
    jitter: float  # Largest random delay of a hand's sample [s].
    rows: tuple[NodeLoad, ...]
    commands_hz: float  # Number of joint commands per second.
    # The result of speed_ripple for the commands, at the times at which a robot follows them.
    speed_ripple: float

    @property
    def total(self) -> NodeLoad:
        """The load of all nodes together."""
        return NodeLoad("all", sum(row.idle for row in self.rows), sum(row.moving for row in self.rows))


class LoadError(Q2R2Error):
    """An error of nodes that did not start in time. The message says what was waited for."""


def speed_ripple(times: Array, q: Array) -> float:
    """Return the RMS of the differences between joint speeds and their trend, divided by the trend's RMS.

    The speeds are computed from the joint positions ``q`` (n, nv) [rad] at the ascending ``times`` (n,) [s]. The trend
    is a mean of the speeds over 0.15 s, weighted by a Hann window.
    """
    dt = np.diff(times)
    v = np.diff(q, axis=0) / dt[:, None]
    window = np.hanning(2 * max(round(_TREND_WINDOW_S / float(np.median(dt)) / 2.0), 1) + 1)
    trend = np.apply_along_axis(lambda column: np.convolve(column, window / window.sum(), "valid"), 0, v)
    margin = len(window) // 2
    ripple = v[margin : len(v) - margin] - trend
    return float(np.sqrt((ripple**2).sum() / (trend**2).sum()))


def measure_load(config: str, duration: float, rate: float) -> LoadReport:
    """Measure for ``duration`` [s] at rest, and for the same time with both arms moving.

    The nodes of the robot and of the controller run at ``rate`` [Hz]. Raises :class:`LoadError` if a node does not
    start in time or an arm is paused.
    """
    nodes, arms = nodes_of(config, "none"), len(load_config(config).arms)
    nodes = [
        replace(node, parameters={**node.parameters, "rate": rate}) if node.name in _NODES_WITH_RATE else node
        for node in nodes
    ]
    with private_domain(), _Watcher() as watcher, started(nodes) as processes:
        print_progress("Waiting for all nodes.")
        watcher.wait(lambda: watcher.active and len(watcher.engaged) == arms, "the nodes")
        watcher.spin(_SETTLING_S)
        print_progress(f"idle: {duration:g} s")
        idle = watcher.shares(processes, duration)
        with started([_SCRIPTED_HANDS]) as script:
            print_progress("Waiting for the arms to follow.")
            watcher.wait(lambda: all(watcher.engaged.values()), "the arms to follow")
            watcher.spin(_SETTLING_S)
            print_progress(f"moving: {duration:g} s")
            watcher.forget_commands()
            moving = watcher.shares(processes | script, duration)
    if not all(watcher.engaged.values()):
        raise LoadError(f"an arm was paused within {duration:g} s: {watcher.last_event}")
    times, q = watcher.commands()
    rows = tuple(NodeLoad(name, idle.get(name, 0.0), moving[name]) for name in moving)
    return LoadReport(duration, _SAMPLE_JITTER_S, rows, len(times) / duration, speed_ripple(times_of_a_robot(times), q))


class _Watcher:
    """A node that listens to the nodes' states, and to joint commands with the times at which they were published."""

    def __init__(self) -> None:
        self.active = False  # True if the controller is active.
        self.engaged: dict[str, bool] = {}  # True for each arm that is engaged.
        self.last_event: dict[str, str] = {}  # Last event of each arm.
        self._commands: list[tuple[int, bytes]] = []  # Time [ns] and serialized message of each command.
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("load_watcher", context=self._context)
        # Messages are read after the run, because reading them at once would take as much time as a node takes.
        # ``listen`` has the type Any, because rclpy's type hints lack callbacks that get the message's stamps.
        listen: Any = self._on_command
        qos = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)
        node: Any = self._node
        node.tick_group = TickGroup()
        node.create_subscription(
            JointTrajectory, "/joint_trajectory", listen, qos, raw=True, callback_group=node.tick_group
        )
        for name in ("cartesian_controller", "left_q2r2_arm_controller", "right_q2r2_arm_controller"):
            self._node.create_subscription(String, f"/{name}/state", partial(self._on_state, name), 10)
        self._executor = TickExecutor(context=self._context)
        self._executor.add_node(self._node)

    def __enter__(self) -> _Watcher:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def wait(self, condition: Callable[[], object], what: str) -> None:
        """Listen until ``condition`` holds."""
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not condition():
            if time.monotonic() > deadline:
                raise LoadError(f"waited {_START_TIMEOUT_S:g} s for {what}")
            self._executor.spin_once(0.05)

    def spin(self, period: float) -> None:
        """Listen for ``period`` [s]."""
        end = time.monotonic() + period
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(left)

    def shares(self, processes: Mapping[str, int], duration: float) -> dict[str, float]:
        """Measure for ``duration`` [s], and return the share of one core that each process takes, in percent."""
        began, before = time.monotonic(), {name: processor_time(pid) for name, pid in processes.items()}
        self.spin(duration)
        passed = time.monotonic() - began
        return {name: 100.0 * (processor_time(pid) - before[name]) / passed for name, pid in processes.items()}

    def forget_commands(self) -> None:
        self._commands.clear()

    def commands(self) -> tuple[Array, Array]:
        """Return times (n,) [s] and positions (n, nv) [rad] of the received commands."""
        messages = [deserialize_message(payload, JointTrajectory) for _, payload in self._commands]
        times = 1e-9 * np.array([at for at, _ in self._commands], dtype=float)
        return times, np.array([message.points[0].positions for message in messages])

    def _on_command(self, payload: bytes, info: dict[str, int]) -> None:
        self._commands.append((info["source_timestamp"], payload))

    def _on_state(self, name: str, message: String) -> None:
        state = json.loads(message.data)
        if name == "cartesian_controller":
            self.active = state["phase"] == "active"
        else:
            self.engaged[state["arm"]], self.last_event[state["arm"]] = state["engaged"], state["last_event"]


def times_of_a_robot(times: Array) -> Array:
    """Return the times at which a robot follows commands that were sent at ``times`` (n,) [s].

    The robot takes the newest command once in each of its own periods. Therefore small differences between the times of
    commands do not matter. If a command is missing, the robot follows the next command after two periods.
    """
    gaps = np.diff(times)
    period = float(np.median(gaps))
    periods = np.maximum(np.round(gaps / period), 1.0)
    return np.concatenate([[0.0], period * np.cumsum(periods)])


def main(
    duration: Annotated[
        float, typer.Option(min=1, max=3600, help="Duration of each measurement, at rest and in motion [s].")
    ] = 30.0,
    rate: Annotated[float, typer.Option(min=20, max=1000, help="Rate of robot and controller [Hz].")] = 250.0,
    json: Json = False,
) -> None:
    """Print the processor time of each node, and the ripple of the commanded speeds."""
    report = measure_load(DEMO_CONFIG, duration, rate)
    table = figure_table(
        f"Nodes of q2r2 ros up with the loops at {rate:g} Hz, {duration:g} s each",
        ("node", "idle [% of a core]", "moving [% of a core]"),
        ((row.node, row.idle, row.moving) for row in (*report.rows, report.total)),
        (
            "moving: Both hands go round circles, with samples that are up to "
            f"{1e3 * report.jitter:g} ms late. There are {report.commands_hz:.0f} joint commands per second, "
            f"and their speeds have a ripple of {100.0 * report.speed_ripple:.1f} % RMS.",
        ),
    )
    print_report(asdict(report) | {"total": asdict(report.total)}, (table,), json)


if __name__ == "__main__":
    typer.run(main)
