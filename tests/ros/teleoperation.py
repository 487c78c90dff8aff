"""A whole teleoperation as processes, which tests kill, freeze and restart; and what they ask of it afterwards.

Timeouts are longer than by default, so that other load on the machine does not look like a fault. Times are those of
joint states received here, on the machine's steady clock; they are reported, since they depend on that load.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from q2r2_control import Robot
from q2r2_control.ros.base_node import COMMAND_QOS, STREAM_QOS
from q2r2_control.types import SIDES, Array
from tests.ros import cell
from tests.ros.arm_rig import PATIENT
from tests.ros.circling_operator import Operator
from tests.ros.joint_recorder import JointRecorder, Stop
from tests.ros.processes import CONFIG, Processes, RosProcess
from tests.ros.waiting import wait_until

RATE = 100.0  # half of the nodes' default or less, since all processes share a test machine [Hz]
MOVING = 0.2  # an arm that moves has a joint this fast [rad/s]
STILL = 0.005  # a joint that stands moves no farther [rad]
ANCHORED = 0.005  # a tool whose hand rests moves no farther [m]
# When hands move at 0.3 m/s the fastest joint turns at 0.9: a jump to an old target would be faster [rad/s].
FAST = 1.7
AWHILE = 0.5  # in which something would have moved if anything did [s]
TIMEOUTS = PATIENT | {"teleop.gate.timeout": 1.0}  # less than a node is frozen for
ENDPOINT = "tcp_endpoint"
NAMES = ("mujoco_robot", "cartesian_controller", "arm_controllers", ENDPOINT)

Record = Callable[[str, object], None]


class Teleoperation:
    """The processes, a subscriber of what they publish, and the operator."""

    operator: Operator

    def __init__(self, node: Any, robot: Robot, processes: Processes) -> None:
        self.node, self.robot = node, robot
        self.joints = JointRecorder(robot)
        self.joints.subscribe(node, STREAM_QOS)
        self.commands: list[tuple[float, Array]] = []  # receipt [s] and commanded joint positions [rad]
        self.diagnoses: list[tuple[float, str]] = []  # receipt [s] and a line
        self._states: dict[str, tuple[float, dict[str, Any]]] = {}  # receipt [s]
        self._processes, self._port = processes, "0"
        self._running: dict[str, RosProcess] = {}
        node.create_subscription(JointTrajectory, "/joint_trajectory", self._on_command, COMMAND_QOS)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 100)
        for name in ("cartesian_controller", *(f"{arm}_q2r2_arm_controller" for arm in SIDES)):
            node.create_subscription(String, f"/{name}/state", lambda m, name=name: self._on_state(name, m), 10)

    def start(self, name: str) -> None:
        """Start a node."""
        parameters = {
            "mujoco_robot": (f"config:={CONFIG}", f"rate:={RATE}", "max_jump:=1.0"),  # it makes jumps, to be seen
            "cartesian_controller": (f"config:={CONFIG}", f"rate:={RATE}", *cell.PATIENT),
            "arm_controllers": (f"rate:={RATE}", *(f"{key}:={value}" for key, value in TIMEOUTS.items())),
            ENDPOINT: (f"port:={self._port}",),
        }
        self._running[name] = process = self._processes.start_node(name, *parameters[name])
        if name == ENDPOINT:
            self._port = process.wait_for("listening on ").rsplit(":", 1)[-1]

    @contextmanager
    def connected(self) -> Iterator[None]:
        """Start all nodes, and connect the headset."""
        for name in NAMES:
            self.start(name)
        with Operator(("127.0.0.1", int(self._port))).streaming() as self.operator:
            yield

    def signal(self, name: str, number: signal.Signals) -> float:
        """Send a node a signal; when that was [s]."""
        sent = time.monotonic()
        os.kill(self._running[name].pid, number)
        return sent

    def kill(self, name: str) -> float:
        """End a node by SIGKILL; when that was [s]."""
        sent = self.signal(name, signal.SIGKILL)
        self._running[name].wait()
        return sent

    def restore(self, name: str) -> None:
        """Restart a node that was killed, continue one that is frozen."""
        if self._running[name].running:
            self.signal(name, signal.SIGCONT)
        else:
            self.start(name)

    def engaged(self, arm: str) -> bool:
        """Whether an arm followed its hand when it last reported, which it does at every change."""
        return bool(self._state(f"{arm}_q2r2_arm_controller", 0.0).get("engaged"))

    def controller_is(self, phase: str, since: float) -> bool:
        """Whether the controller has reported that after ``since`` [s]."""
        return bool(self._state("cartesian_controller", since).get("phase") == phase)

    def press(self) -> None:
        """Engage both arms, each by its own hand."""
        now = time.monotonic()

        def ready(arm: str) -> bool:
            level = self._state(f"{arm}_q2r2_arm_controller", now).get("level")
            return level == "ok" and self.controller_is("active", now)

        wait_until(lambda: all(map(ready, SIDES)), "both arms are ready", lambda: self._states)
        self.operator.press(*(arm for arm in SIDES if not self.engaged(arm)))
        wait_until(lambda: all(map(self.engaged, SIDES)), "both arms are engaged", lambda: self._states)

    def move(self) -> None:
        """Let both arms follow their hands at 0.3 m/s."""
        if not all(map(self.engaged, SIDES)):
            self.operator.rest()
            self.press()
        self.operator.moves = True

        def moving() -> bool:
            speeds = self.joints.speeds(0.02)
            return all(float(speeds[self.robot.arms[arm].joints].max()) > MOVING for arm in SIDES)

        wait_until(moving, "both arms move", lambda: self.diagnoses[-5:])
        time.sleep(0.3)  # until they are fast

    def measure_stop(self, what: str, fault: float, record: Record) -> Stop:
        """How both arms have come to rest after a ``fault`` at that time [s]."""
        stop = self.joints.stop_after(fault)
        line = (
            f"from {stop.speed:.2f} rad/s, {stop.fastest:.2f} at most, slow within {1e3 * stop.slow:.0f} ms, at rest "
            f"within {1e3 * stop.rest:.0f} ms; without joint states for up to {1e3 * stop.starved:.0f} ms"
        )
        record(what, line)
        print(f"\n{what}: {line}")
        assert self.joints.fastest(stop.fault) < FAST
        return replace(stop, posture=self.joints.wait_for_rest(), t=time.monotonic())

    def assert_only_a_press_moves(self, stop: Stop) -> None:
        """Nothing has moved since the stop; a press moves nothing either, but from then on the arms follow."""
        time.sleep(AWHILE)
        assert self.joints.farthest_from(stop.posture, stop.t) < STILL
        self.operator.rest(stop.t)
        began = time.monotonic()
        self.press()
        time.sleep(AWHILE)
        assert self.joints.tool_farthest_from(stop.posture, began) < ANCHORED  # elbows may, towards their posture
        self.move()
        assert self.joints.fastest(began) < FAST

    def wait_for_diagnosis(self, since: float, text: str) -> None:
        """Wait for a line in /diagnostics after ``since`` [s] with ``text``."""

        def found() -> bool:
            return any(t > since and text in line for t, line in self.diagnoses[:])

        wait_until(found, f"a diagnosis with {text}", lambda: self.diagnoses[-5:])

    def _state(self, name: str, since: float) -> dict[str, Any]:
        t, state = self._states.get(name, (-1.0, {}))
        return state if t > since else {}

    def _on_command(self, message: JointTrajectory) -> None:
        self.commands.append((time.monotonic(), np.array(message.points[0].positions)))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        self.diagnoses += [(time.monotonic(), status.message) for status in message.status]

    def _on_state(self, name: str, message: String) -> None:
        self._states[name] = time.monotonic(), json.loads(message.data)
