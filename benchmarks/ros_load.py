"""How much processor time does the set of ``q2r2 ros up`` need, and how evenly do its commands move?"""

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
from q2r2_control.config.cell import load_config
from q2r2_control.errors import Q2R2Error
from q2r2_control.ros.executor import TickExecutor, TickGroup
from q2r2_control.ros.launch.processes import NodeProcess, nodes_of
from q2r2_control.types import Array
from q2r2_control.viewer.tables import figure_table
from ros_processes import private_domain, processor_time, started

_START_TIMEOUT = 300.0  # kernels may have to be compiled [s]
_SETTLE = 3.0  # after the nodes have begun, and after the hands have [s]
_JITTER = 0.002  # of a headset's samples: each comes later by up to this [s]
_TREND = 0.15  # a slower motion is the hand's own, a faster one is ripple [s]
_RATED = "mujoco_robot", "cartesian_controller"
_SCRIPT = NodeProcess("SimulationInput", {"jitter": _JITTER})


@dataclass(frozen=True, slots=True)
class NodeLoad:
    """Processor time of one node, in percent of one core."""

    node: str
    idle: float  # all are up and no arm is engaged
    moving: float  # both arms follow circles


@dataclass(frozen=True, slots=True)
class LoadReport:
    """The measured figures of the whole set."""

    seconds: float  # of each of both
    jitter: float  # each sample of the hands comes later by up to this, at random [s]
    rows: tuple[NodeLoad, ...]
    commands_hz: float
    speed_ripple: float  # RMS of the joints' commanded speed about its trend, as a share of its RMS, to a robot

    @property
    def total(self) -> NodeLoad:
        """All nodes together."""
        return NodeLoad("all", sum(row.idle for row in self.rows), sum(row.moving for row in self.rows))


class LoadError(Q2R2Error):
    """The nodes did not begin in time; the message says what was waited for."""


def speed_ripple(times: Array, q: Array) -> float:
    """RMS of the speeds between joint positions about their trend, as a share of the trend's RMS.

    ``times`` (n,) [s], ascending; ``q`` (n, nv) [rad]. The trend is a mean over 0.15 s, weighted by a Hann window.
    """
    dt = np.diff(times)
    v = np.diff(q, axis=0) / dt[:, None]
    window = np.hanning(2 * max(round(_TREND / float(np.median(dt)) / 2.0), 1) + 1)
    trend = np.apply_along_axis(lambda column: np.convolve(column, window / window.sum(), "valid"), 0, v)
    margin = len(window) // 2
    ripple = v[margin : len(v) - margin] - trend
    return float(np.sqrt((ripple**2).sum() / (trend**2).sum()))


def measure_load(config: str, duration: float, rate: float) -> LoadReport:
    """Measure for ``duration`` [s] at rest, and as long with both arms moving. Raises :class:`LoadError`.

    ``rate`` of robot and controller [Hz].
    """
    nodes, arms = nodes_of(config, "none"), len(load_config(config).arms)
    nodes = [
        replace(node, parameters={**node.parameters, "rate": rate}) if node.name in _RATED else node for node in nodes
    ]
    with private_domain(), _Watcher() as watcher, started(nodes) as processes:
        print_progress("waiting for all nodes")
        watcher.wait(lambda: watcher.active and len(watcher.engaged) == arms, "the nodes")
        watcher.spin(_SETTLE)
        print_progress(f"idle: {duration:g} s")
        idle = watcher.shares(processes, duration)
        with started([_SCRIPT]) as script:
            print_progress("waiting for the arms to follow")
            watcher.wait(lambda: all(watcher.engaged.values()), "the arms to follow")
            watcher.spin(_SETTLE)
            print_progress(f"moving: {duration:g} s")
            watcher.forget_commands()
            moving = watcher.shares(processes | script, duration)
    if not all(watcher.engaged.values()):
        raise LoadError(f"an arm was paused within {duration:g} s: {watcher.last_event}")
    times, q = watcher.commands()
    rows = tuple(NodeLoad(name, idle.get(name, 0.0), moving[name]) for name in moving)
    return LoadReport(duration, _JITTER, rows, len(times) / duration, speed_ripple(times_of_a_robot(times), q))


class _Watcher:
    """Listens to the nodes' states and to the joint commands, whose times are the middleware's at the sender."""

    def __init__(self) -> None:
        self.active = False  # the controller
        self.engaged: dict[str, bool] = {}  # by arm
        self.last_event: dict[str, str] = {}  # by arm
        self._commands: list[tuple[int, bytes]] = []  # time [ns] and message
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("load_watcher", context=self._context)
        # Read after the run: a watcher that reads while it listens takes as much time as a node.
        listen: Any = self._on_command  # rclpy's types know callbacks without the message's stamps only
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
        deadline = time.monotonic() + _START_TIMEOUT
        while not condition():
            if time.monotonic() > deadline:
                raise LoadError(f"waited {_START_TIMEOUT:g} s for {what}")
            self._executor.spin_once(0.05)

    def spin(self, period: float) -> None:
        """Listen for ``period`` [s]."""
        end = time.monotonic() + period
        while (left := end - time.monotonic()) > 0.0:
            self._executor.spin_once(left)

    def shares(self, processes: Mapping[str, int], duration: float) -> dict[str, float]:
        """The share of one core that each process takes for ``duration`` [s], in percent."""
        began, before = time.monotonic(), {name: processor_time(pid) for name, pid in processes.items()}
        self.spin(duration)
        passed = time.monotonic() - began
        return {name: 100.0 * (processor_time(pid) - before[name]) / passed for name, pid in processes.items()}

    def forget_commands(self) -> None:
        self._commands.clear()

    def commands(self) -> tuple[Array, Array]:
        """Times (n,) [s] and positions (n, nv) [rad] of those that were heard."""
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
    """When a robot follows commands that were sent at ``times`` (n,) [s]: one of its own periods after the other.

    It takes the newest command once a period, so a command that is a little early or late makes no difference. Where
    one is missing it waits for two.
    """
    gaps = np.diff(times)
    period = float(np.median(gaps))
    periods = np.maximum(np.round(gaps / period), 1.0)
    return np.concatenate([[0.0], period * np.cumsum(periods)])


def main(
    duration: Annotated[float, typer.Option(min=1, max=3600, help="At rest, and again moving [s].")] = 30.0,
    rate: Annotated[float, typer.Option(min=20, max=1000, help="Of robot and controller [Hz].")] = 250.0,
    json: Json = False,
) -> None:
    """Print what each node takes of the processors, and how much the commanded speeds ripple."""
    report = measure_load(DEMO_CONFIG, duration, rate)
    table = figure_table(
        f"the nodes of q2r2 ros up with the loops at {rate:g} Hz, {duration:g} s each",
        ("node", "idle [% of a core]", "moving [% of a core]"),
        ((row.node, row.idle, row.moving) for row in (*report.rows, report.total)),
        (
            f"moving: {report.commands_hz:.0f} joint commands a second; their speeds ripple by "
            f"{100.0 * report.speed_ripple:.1f} % RMS while both hands go round circles,",
            f"with samples up to {1e3 * report.jitter:g} ms late",
        ),
    )
    print_report(asdict(report) | {"total": asdict(report.total)}, (table,), json)


if __name__ == "__main__":
    typer.run(main)
