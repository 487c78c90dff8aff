"""The simulated robot, moved by strict controllers that arm controllers drive with a preset."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from std_msgs.msg import String

from q2r2_control import Robot
from q2r2_control.config.presets import PRESETS
from q2r2_control.config.teleop import GuardSettings
from tests.ros.arm_rig import ArmRig, ArmRigs
from tests.ros.cell import start_controller, start_robot
from tests.ros.conftest import spun_node
from tests.ros.joint_recorder import JointRecorder
from tests.ros.processes import Processes, RosProcess
from tests.ros.programs.impedance_model import NATURAL_FREQUENCY
from tests.ros.programs.strict_controllers import FASTEST, STALL, Terms
from tests.ros.waiting import call, wait_until

# Longer than by default, so that other load on the machine does not look like a fault.
PATIENT = ("joint_state_timeout:=1.0", "target_timeout:=1.0", "deviation_time:=2.0", "listener_timeout:=0.5")
STILL = 2e-3  # how far a tool at rest may move [m]
NEAR = 5e-3  # a tool this near has arrived [m]


class PresetBench:
    """The simulated robot and the built-in controller, which are used by several tests."""

    def __init__(self, domain: int, node: Any, robot: Robot, processes: Processes, right_arm: Path) -> None:
        self.domain, self.node, self.joints = domain, node, JointRecorder(robot)
        self.joints.subscribe(node)
        self._phase = ""
        self._processes, self._right_arm = processes, right_arm
        self._controller: RosProcess | None = None
        self._parameters: tuple[str, ...] = ()
        node.create_subscription(String, "/cartesian_controller/state", self._on_state, 10)
        start_robot(processes)

    def reset(self, *parameters: str, **environment: str) -> None:
        """At home and active, with a built-in controller of these parameters for the right arm alone.

        The left arm is moved by the strict controllers only, which would stop a controller of both arms.
        """
        if self._controller is None or parameters != self._parameters:
            if self._controller is not None:
                self._controller.interrupt()
            call(self.node, "/mujoco_robot/reset")
            self._parameters, self._phase = parameters, ""
            given = (f"config:={self._right_arm}", *parameters, *PATIENT)
            self._controller = start_controller(self._processes, *given, **environment)
        else:
            call(self.node, "/cartesian_controller/stop")
            wait_until(lambda: self._phase == "stopped", "the built-in controller is stopped")
            call(self.node, "/mujoco_robot/reset")
            call(self.node, "/cartesian_controller/reset")
        wait_until(lambda: self._phase == "active", "the built-in controller is active")
        self.joints.states.clear()
        wait_until(lambda: self.joints.states, "joint states come")

    def _on_state(self, message: Any) -> None:
        self._phase = json.loads(message.data)["phase"]


class StrictControllers:
    """The process of the strict controllers, which can be killed and started again."""

    def __init__(self, processes: Processes, terms: Terms, environment: dict[str, str]) -> None:
        self._processes, self._terms, self._environment = processes, terms, environment
        self._runs: list[RosProcess] = []

    def start(self) -> None:
        terms = json.dumps(asdict(self._terms))
        program = "tests.ros.programs.strict_controllers"
        self._runs.append(self._processes.start_module(program, terms, **self._environment))

    def wait_until_ready(self) -> None:
        self._runs[-1].wait_for("ready")

    def receives_targets(self, rigs: ArmRigs) -> bool:
        """Whether the arms' first targets have arrived."""
        output = self._runs[-1].output
        return all(f"first target of {rig.arm}" in output for rig in rigs.rigs)

    def engage(self, rigs: ArmRigs) -> None:
        """Engage once nothing has changed for a while, since controllers come and go; returns when targets arrive."""
        rigs.wait_until_ready(3)
        rigs.engage()
        wait_until(lambda: self.receives_targets(rigs), "targets arrive")

    def kill(self) -> None:
        os.kill(self._runs[-1].pid, signal.SIGKILL)
        self._runs[-1].wait()

    @property
    def violations(self) -> list[str]:
        """The lines that say which rule a target broke."""
        return [line for run in self._runs for line in run.output.splitlines() if line.startswith("violation")]


def run_through(bench: PresetBench, rigs: ArmRigs, controllers: StrictControllers, guard: GuardSettings) -> None:
    """All that happens in teleoperation: motion, a pause, lost hand data, a controller that is restarted.

    A critically damped impedance moves the tool no faster than its target does, but for a fifth, nor more abruptly, but
    for what the target catches up after a stall of the machine.
    """
    joints = bench.joints
    catching_up = NATURAL_FREQUENCY**2 * FASTEST * STALL
    limits = 1.2 * guard.max_velocity, 1.2 * guard.max_angular_velocity, guard.max_acceleration + catching_up
    controllers.wait_until_ready()
    rigs.wait(lambda rig: rig.state.get("hand_age") is not None, "the arm's controller receives the hand")
    began = time.monotonic()
    with joints.tools_rest(STILL, "it is engaged"):
        controllers.engage(rigs)
    move(bench, rigs, (0.06, 0.0, 0.04), turn=0.2)

    rigs.pause()
    joints.wait_for_rest()
    with joints.tools_rest(STILL, "it is paused and engaged again"):
        rigs.move((-0.5, 0.2, 0.0), 0.05, turn=1.0)
        rigs.engage()
    move(bench, rigs, (0.0, 0.06, 0.0))

    with joints.tools_rest(STILL, "its hand data are lost and come back"):
        rigs.interrupt_hand_data()
        rigs.engage()
    move(bench, rigs, (0.0, 0.0, 0.06))
    joints.assert_smooth(began, *limits)

    controllers.kill()
    rigs.move((0.1, 0.0, 0.0), 0.3)  # the restarted controller must not be asked to catch up with that
    rigs.wait_for_pause()
    joints.wait_for_rest()
    with joints.tools_rest(STILL, "its controller is restarted"):
        controllers.start()
        controllers.wait_until_ready()
        began = time.monotonic()
        controllers.engage(rigs)
    move(bench, rigs, (-0.05, 0.0, 0.0))
    joints.assert_smooth(began, *limits)
    assert controllers.violations == []


def move(bench: PresetBench, rigs: ArmRigs, by: tuple[float, float, float], turn: float = 0.0) -> None:
    """Move the hands, and wait until the arms have followed."""
    tools = {rig.arm: bench.joints.tool(rig.arm).translation for rig in rigs.rigs}
    rigs.move(by, 0.3, turn)

    def arrived() -> bool:
        ways = [bench.joints.tool(arm).translation - tool - np.array(by) for arm, tool in tools.items()]
        return all(float(np.linalg.norm(way)) < NEAR for way in ways)

    wait_until(arrived, "the arms arrive", lambda: [rig.state for rig in rigs.rigs])
    bench.joints.wait_for_rest()


@contextmanager
def arm_controllers(
    bench: PresetBench, processes: Processes, preset: str, modes: dict[str, str], environment: dict[str, str]
) -> Iterator[ArmRigs]:
    """Arm controllers with a preset, and the rigs that drive them; ``modes`` has the mode of each arm."""
    with spun_node(bench.domain, "hands") as node:
        yield ArmRigs([start_arm(node, processes, preset, arm, mode, environment) for arm, mode in modes.items()])


def start_arm(node: Any, processes: Processes, preset: str, arm: str, mode: str, environment: dict[str, str]) -> ArmRig:
    prefix = f"/robot/{arm}_ctrl"
    topic = PRESETS[preset].topic.format(ctrl=prefix) if mode == "raw" else "/unused/target_frame"
    rig = ArmRig(node, arm, topic=topic)
    rig.sends_tool = rig.follows = False
    given = {
        "preset": preset,
        "mode": mode,
        "ctrl_prefix": prefix,
        "controller_node": prefix,
        "base_frame_id": f"{arm}_link_0",
        "world_frame_id": "world",
        "teleop.linked": False,
        "teleop.gate.timeout": 1.0,
        "teleop.leash.distance": 0.0,  # an arm that lags on an overloaded machine is not held up by an obstacle
        "tool_timeout": 1.0,
        "listener_timeout": 1.0,
    }
    if mode == "raw":
        given["following_topic"] = f"{prefix}/following"  # which the strict controllers do not publish
    parameters = (f"{name}:={value}" for name, value in given.items())
    processes.start_node(f"{arm}_arm_controller", *parameters, **environment)
    return rig
