"""A whole set of nodes as a user runs it, that tests hurt: killed, frozen, started again; and what it says and does."""

from __future__ import annotations

import json
import os
import signal
import time
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from q2r2_control import Robot
from q2r2_control.ros.base_node import COMMAND_QOS, STREAM_QOS
from q2r2_control.types import Array
from tests.ros.cell import CONFIG
from tests.ros.joint_log import JointLog
from tests.ros.processes import Processes, RosProcess
from tests.ros.waiting import eventually

ARMS = ("left", "right")
RATE = 100.0  # of the nodes: half of their own or less, since six processes share a test machine [Hz]
MOVING = 0.2  # an arm that moves has a joint this fast [rad/s]


class Diagnosis(NamedTuple):
    """What a node said of itself."""

    t: float  # receipt [s]
    node: str
    line: str


class TeleopCell:
    """The nodes as processes, seen from a node of the test that only listens."""

    def __init__(self, node: Any, robot: Robot, processes: Processes) -> None:
        self.node, self.robot = node, robot
        self.joints = JointLog(robot.joint_names)
        self.commands: list[tuple[float, Array]] = []  # receipt [s] and joint positions [rad] asked for
        self.diagnoses: list[Diagnosis] = []
        self._states: dict[str, tuple[float, dict[str, Any]]] = {}
        self._processes = processes
        self._running: dict[str, RosProcess] = {}
        node.create_subscription(JointState, "/joint_states", self._on_joint_state, STREAM_QOS)
        node.create_subscription(JointTrajectory, "/joint_trajectory", self._on_command, COMMAND_QOS)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        for name in ("cartesian_controller", *(f"{arm}_q2r2_arm_controller" for arm in ARMS)):
            node.create_subscription(String, f"/{name}/state", lambda m, name=name: self._on_state(name, m), 10)

    def start(self, name: str, *parameters: str) -> RosProcess:
        """Start one of the package's nodes, or start it again."""
        module = f"q2r2_control.ros.nodes.{name}"
        given = [] if name == "tcp_endpoint" else [f"rate:={RATE}"]
        given += [f"config:={CONFIG}"] if name in ("mujoco_robot", "cartesian_controller") else []
        arguments = [part for parameter in (*given, *parameters) for part in ("-p", parameter)]
        process = self._processes.start_module(module, "--ros-args", *arguments)
        self._running[name] = process
        return process

    def signal(self, name: str, number: signal.Signals) -> float:
        """Send a node a signal; when that was [s]."""
        sent = time.monotonic()
        os.kill(self._running[name].pid, number)
        return sent

    def mend(self, name: str, *parameters: str) -> None:
        """Start a node that does not run, and let one that is frozen go on."""
        if self._running[name].running:
            self.signal(name, signal.SIGCONT)
        else:
            self.start(name, *parameters)

    def call(self, service: str) -> None:
        """Ask for a service, and wait until it is granted."""
        client = self.node.create_client(Trigger, service)
        eventually(client.service_is_ready, f"{service} is there")
        future = client.call_async(Trigger.Request())
        eventually(future.done, f"{service} answers")
        assert future.result().success, future.result().message
        self.node.destroy_client(client)

    def kill(self, name: str) -> float:
        """End a node without any last word; when that was [s]."""
        sent = self.signal(name, signal.SIGKILL)
        self._running[name].wait()
        return sent

    def engaged(self, arm: str) -> bool:
        """Whether an arm followed its hand when it last said so, which it does at every change."""
        return bool(self._state(f"{arm}_q2r2_arm_controller", 0.0).get("engaged"))

    def controller_is(self, phase: str, since: float) -> bool:
        """Whether the controller has said that after ``since`` [s]."""
        return bool(self._state("cartesian_controller", since).get("phase") == phase)

    def ready(self, arm: str, since: float) -> bool:
        """Whether nothing keeps an arm from being engaged, as was said after ``since`` [s]."""
        level = self._state(f"{arm}_q2r2_arm_controller", since).get("level")
        return level == "ok" and self.controller_is("active", since)

    def wait_until_ready(self) -> None:
        """Until nothing keeps either arm from being engaged, all of it said from now on."""
        now = time.monotonic()
        eventually(lambda: all(self.ready(arm, now) for arm in ARMS), "both arms are ready")

    @property
    def moving(self) -> bool:
        """Whether both arms are fast."""

        def moves(joints: Array) -> bool:
            return bool(self.joints.speeds(0.02)[joints].max() > MOVING)

        return all(moves(self.robot.arms[arm].joints) for arm in ARMS)

    def tools_moved(self, posture: Array, since: float) -> float:
        """How far any tool has been from where it is in ``posture`` [m]."""
        moved = 0.0
        for arm in ARMS:
            start = self.robot.tool_pose(posture, arm).translation
            ways = [self.robot.tool_pose(state.q, arm).translation - start for state in self.joints.since(since)]
            moved = max(moved, *(float(np.linalg.norm(way)) for way in ways))
        return moved

    def wait_for_diagnosis(self, since: float, *texts: str) -> Diagnosis:
        """The first line in /diagnostics after ``since`` [s] with all of ``texts``."""
        found: list[Diagnosis] = []

        def look() -> bool:
            lines = [one for one in self.diagnoses[:] if one.t > since and all(text in one.line for text in texts)]
            found.extend(lines[:1])
            return bool(found)

        eventually(look, f"a diagnosis with {texts}")
        return found[0]

    def _state(self, name: str, since: float) -> dict[str, Any]:
        t, state = self._states.get(name, (-1.0, {}))
        return state if t > since else {}

    def _on_joint_state(self, message: JointState) -> None:
        self.joints.take(message.name, message.position, message.velocity, time.monotonic())

    def _on_command(self, message: JointTrajectory) -> None:
        self.commands.append((time.monotonic(), np.array(message.points[0].positions)))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.diagnoses += [Diagnosis(time.monotonic(), status.name, status.message) for status in message.status]

    def _on_state(self, name: str, message: String) -> None:
        self._states[name] = time.monotonic(), json.loads(message.data)


def address_of(endpoint: RosProcess) -> tuple[str, int]:
    """Where a tcp_endpoint listens."""
    host, port = endpoint.wait_for("listening on ").rsplit(" ", 1)[-1].split(":")
    return host, int(port)
