"""All nodes of a teleoperation as processes, which tests kill, freeze and restart; and what they publish."""

from __future__ import annotations

import json
import os
import signal
import time
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from q2r2_control import Robot
from q2r2_control.ros.base_node import COMMAND_QOS, STREAM_QOS
from q2r2_control.types import Array
from tests.ros.joint_recorder import JointRecorder
from tests.ros.processes import CONFIG, Processes, RosProcess
from tests.ros.waiting import call, wait_until

ARMS = ("left", "right")
RATE = 100.0  # half of the nodes' default or less, since six processes share a test machine [Hz]
MOVING = 0.2  # an arm that moves has a joint this fast [rad/s]


class Diagnosis(NamedTuple):
    """One line of /diagnostics."""

    t: float  # receipt [s]
    node: str
    line: str


class TeleopNodes:
    """The processes, and a subscriber of what they publish."""

    def __init__(self, node: Any, robot: Robot, processes: Processes) -> None:
        self.node, self.robot = node, robot
        self.joints = JointRecorder(robot)
        self.joints.subscribe(node, STREAM_QOS)
        self.commands: list[tuple[float, Array]] = []  # receipt [s] and commanded joint positions [rad]
        self.diagnoses: list[Diagnosis] = []
        self._states: dict[str, tuple[float, dict[str, Any]]] = {}
        self._engaged: list[tuple[float, str, bool]] = []  # receipt [s], arm, and whether it was engaged
        self._processes = processes
        self._running: dict[str, RosProcess] = {}
        node.create_subscription(JointTrajectory, "/joint_trajectory", self._on_command, COMMAND_QOS)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        for name in ("cartesian_controller", *(f"{arm}_q2r2_arm_controller" for arm in ARMS)):
            node.create_subscription(String, f"/{name}/state", lambda m, name=name: self._on_state(name, m), 10)

    def start(self, name: str, *parameters: str) -> RosProcess:
        """Start a node."""
        given = [] if name == "tcp_endpoint" else [f"rate:={RATE}"]
        given += [f"config:={CONFIG}"] if name in ("mujoco_robot", "cartesian_controller") else []
        # The robot makes a jump that it is asked for, up to this size, so that tests see it in the joint states.
        given += ["max_jump:=1.0"] if name == "mujoco_robot" else []
        self._running[name] = self._processes.start_node(name, *given, *parameters)
        return self._running[name]

    def signal(self, name: str, number: signal.Signals) -> float:
        """Send a node a signal; when that was [s]."""
        sent = time.monotonic()
        os.kill(self._running[name].pid, number)
        return sent

    def kill(self, name: str) -> float:
        """End a node by SIGKILL, if it runs; when that was [s]."""
        sent = time.monotonic()
        if self._running[name].running:
            sent = self.signal(name, signal.SIGKILL)
            self._running[name].wait()
        return sent

    def restore(self, name: str, *parameters: str) -> None:
        """Restart a node that was killed, continue one that is frozen."""
        if self._running[name].running:
            self.signal(name, signal.SIGCONT)
        else:
            self.start(name, *parameters)

    def engaged(self, arm: str) -> bool:
        """Whether an arm followed its hand when it last reported, which it does at every change."""
        return bool(self._state(f"{arm}_q2r2_arm_controller", 0.0).get("engaged"))

    def alone(self, since: float) -> float:
        """How long one arm was engaged and the other was not, from ``since`` [s] until now, by their reports [s]."""
        engaged = dict.fromkeys(ARMS, False)
        total, before = 0.0, since
        for t, arm, now in [*self._engaged, (time.monotonic(), ARMS[0], None)]:
            if t > since:
                total += (t - before) * (len(set(engaged.values())) > 1)
                before = t
            engaged[arm] = engaged[arm] if now is None else now
        return total

    def controller_is(self, phase: str, since: float) -> bool:
        """Whether the controller has reported that after ``since`` [s]."""
        return bool(self._state("cartesian_controller", since).get("phase") == phase)

    def ready(self, arm: str, since: float) -> bool:
        """Whether nothing keeps an arm from being engaged, by reports after ``since`` [s]."""
        level = self._state(f"{arm}_q2r2_arm_controller", since).get("level")
        return level == "ok" and self.controller_is("active", since)

    def reset_if_stopped(self) -> None:
        """Let the controller forget a stop, which takes a reset: arms on an overloaded machine may deviate for long."""
        if self.controller_is("stopped", 0.0):
            call(self.node, "/cartesian_controller/reset")

    def wait_until_ready(self) -> None:
        """Wait until nothing keeps either arm from being engaged, by reports from now on."""
        now = time.monotonic()
        wait_until(lambda: all(self.ready(arm, now) for arm in ARMS), "both arms are ready", lambda: self._states)

    @property
    def moving(self) -> bool:
        """Whether both arms move fast."""
        speeds = self.joints.speeds(0.02)
        return all(float(speeds[self.robot.arms[arm].joints].max()) > MOVING for arm in ARMS)

    def wait_for_diagnosis(self, since: float, *texts: str) -> None:
        """Wait for a line in /diagnostics after ``since`` [s] with all of ``texts``."""

        def found() -> bool:
            return any(one.t > since and all(text in one.line for text in texts) for one in self.diagnoses[:])

        wait_until(found, f"a diagnosis with {texts}", lambda: self.diagnoses[-5:])

    def _state(self, name: str, since: float) -> dict[str, Any]:
        t, state = self._states.get(name, (-1.0, {}))
        return state if t > since else {}

    def _on_command(self, message: JointTrajectory) -> None:
        self.commands.append((time.monotonic(), np.array(message.points[0].positions)))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.diagnoses += [Diagnosis(time.monotonic(), status.name, status.message) for status in message.status]

    def _on_state(self, name: str, message: String) -> None:
        now, state = time.monotonic(), json.loads(message.data)
        self._states[name] = now, state
        if "arm" in state:
            self._engaged.append((now, state["arm"], state["engaged"]))


def address_of(endpoint: RosProcess) -> tuple[str, int]:
    """Where a tcp_endpoint listens."""
    host, port = endpoint.wait_for("listening on ").rsplit(" ", 1)[-1].split(":")
    return host, int(port)
