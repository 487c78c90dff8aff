"""The simulated robot with controllers of others that move it, and all that happens to who teleoperates it."""

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
from tests.ros.arm_rig import ArmRig
from tests.ros.cell import call, parameters, start, wait
from tests.ros.conftest import spun_node
from tests.ros.hands import Hands
from tests.ros.motion import Motion
from tests.ros.processes import PATIENCE, Processes, RosProcess
from tests.ros.springs import STIFFNESS
from tests.ros.stand_in import FASTEST, STALLED, Terms

PATIENT_CONTROLLER = (
    "joint_state_timeout:=1.0",
    "target_timeout:=1.0",
    "deviation_time:=2.0",
    "listener_timeout:=0.5",
)
STILL = 2e-3  # how far a tool that stands still may move [m]
NEAR = 5e-3  # where a tool has arrived [m]


class Stage:
    """The simulated robot and the built-in controller, which outlive a test."""

    def __init__(self, domain: int, node: Any, robot: Robot, running: Processes, right_arm: Path) -> None:
        self.domain, self.node, self.motion = domain, node, Motion(node, robot)
        self.phase = ""
        self._running, self._right_arm, self._made = running, right_arm, ""
        self._controller: RosProcess | None = None
        node.create_subscription(String, "/cartesian_controller/state", self._on_state, 10)
        start(running, "mujoco_robot")

    def set(self, *given: str, **environment: str) -> None:
        """At home and active, with a built-in controller of these parameters for the right arm alone.

        The left one is moved by others behind its back, which it would stop for.
        """
        if self._controller is None or " ".join(given) != self._made:
            if self._controller is not None:
                self._controller.interrupt()
            call(self.node, "/mujoco_robot/reset")
            self._made, self.phase = " ".join(given), ""
            arguments = parameters(f"config:={self._right_arm}", *given, *PATIENT_CONTROLLER)
            self._controller = start(self._running, "cartesian_controller", *arguments, **environment)
        else:
            call(self.node, "/cartesian_controller/stop")
            wait(lambda: self.phase == "stopped", "the built-in controller is stopped")
            call(self.node, "/mujoco_robot/reset")
            call(self.node, "/cartesian_controller/reset")
        wait(lambda: self.phase == "active", "the built-in controller is active")
        self.motion.moments.clear()
        wait(lambda: self.motion.moments, "joint states come")

    def _on_state(self, message: Any) -> None:
        self.phase = json.loads(message.data)["phase"]


class StandIn:
    """The controllers of others, seen from outside."""

    def __init__(self, processes: Processes, terms: Terms, environment: dict[str, str]) -> None:
        self._processes, self._terms, self._environment = processes, terms, environment
        self.lives: list[RosProcess] = []

    def start(self) -> None:
        terms = json.dumps(asdict(self._terms))
        self.lives.append(self._processes.start_module("tests.ros.stand_in", terms, **self._environment))

    def wait_until_ready(self) -> None:
        self.lives[-1].wait_for("ready")

    def driven(self, hands: Hands) -> bool:
        """Whether the arms' first targets have arrived."""
        output = self.lives[-1].output
        return all(f"first target of {rig.arm}" in output for rig in hands.rigs)

    def engage(self, hands: Hands) -> None:
        """Engage until targets arrive: who is found after the press was not there for the arm's controller."""
        deadline = time.monotonic() + PATIENCE
        while not self.driven(hands):
            assert time.monotonic() < deadline, "no targets arrive"
            hands.engage()
            patience = time.monotonic() + 3.0
            while not self.driven(hands) and time.monotonic() < patience:
                time.sleep(0.01)
        hands.engage()

    def kill(self) -> None:
        os.kill(self.lives[-1].pid, signal.SIGKILL)
        self.lives[-1].wait()

    @property
    def violations(self) -> list[str]:
        return [line for life in self.lives for line in life.output.splitlines() if line.startswith("violation")]


def act(stage: Stage, hands: Hands, stand_in: StandIn, guard: GuardSettings) -> None:
    """All that happens to an operator: a pause, a hand that is lost, a controller that is started anew.

    A spring without overshoot moves the tool no faster than its target does, but for a fifth, nor more abruptly, but
    for what the target makes up for when a busy machine has stalled.
    """
    motion = stage.motion
    made_up = STIFFNESS**2 * FASTEST * STALLED
    limits = 1.2 * guard.max_velocity, 1.2 * guard.max_angular_velocity, guard.max_acceleration + made_up
    stand_in.wait_until_ready()
    hands.wait(lambda rig: rig.state.get("hand_age") is not None, "the arm's controller sees the hand")
    began = len(motion.moments)
    with motion.standing_still(STILL, "it is engaged"):
        stand_in.engage(hands)
    follows(stage, hands, (0.06, 0.0, 0.04), turn=0.2)

    hands.pause()
    motion.wait_for_rest()
    with motion.standing_still(STILL, "it is paused and engaged again"):
        hands.move((-0.5, 0.2, 0.0), 0.05, turn=1.0)
        hands.engage()
    follows(stage, hands, (0.0, 0.06, 0.0))

    with motion.standing_still(STILL, "its hand is lost and comes back"):
        hands.fall_silent()
        hands.engage()
    follows(stage, hands, (0.0, 0.0, 0.06))
    motion.assert_smooth(began, *limits)

    stand_in.kill()
    hands.move((0.1, 0.0, 0.0), 0.3)  # who comes next is not to be asked to catch up with that
    hands.wait_for_pause()
    motion.wait_for_rest()
    with motion.standing_still(STILL, "its controller is started anew"):
        stand_in.start()
        stand_in.wait_until_ready()
        began = len(motion.moments)
        stand_in.engage(hands)
    follows(stage, hands, (-0.05, 0.0, 0.0))
    motion.assert_smooth(began, *limits)
    assert stand_in.violations == []


def follows(stage: Stage, hands: Hands, by: tuple[float, float, float], turn: float = 0.0) -> None:
    """The arms move with the hands."""
    tools = {rig.arm: stage.motion.tool(rig.arm).translation for rig in hands.rigs}
    hands.move(by, 0.3, turn)
    for arm, tool in tools.items():
        stage.motion.wait_for_tool(arm, tool + np.array(by), NEAR)
    stage.motion.wait_for_rest()


@contextmanager
def arms(
    stage: Stage, processes: Processes, preset: str, modes: dict[str, str], environment: dict[str, str]
) -> Iterator[Hands]:
    """Arm controllers by the mode of each, and the hands that drive them."""
    with spun_node(stage.domain, "hands") as node:
        yield Hands([start_arm(node, processes, preset, arm, mode, environment) for arm, mode in modes.items()])


def start_arm(node: Any, processes: Processes, preset: str, arm: str, mode: str, environment: dict[str, str]) -> ArmRig:
    prefix = f"/robot/{arm}_ctrl"
    topic = PRESETS[preset].topic.format(ctrl=prefix) if mode == "raw" else "/nobody/target_frame"
    rig = ArmRig(node, arm, topic=topic)
    rig.tells_tool = rig.follows = False
    given = {
        "preset": preset,
        "mode": mode,
        "ctrl_prefix": prefix,
        "controller_node": prefix,
        "base_frame_id": f"{arm}_link_0",
        "world_frame_id": "world",
        "teleop.linked": False,
        "teleop.gate.timeout": 0.5,
        "teleop.leash.distance": 0.0,  # a simulation that a busy machine holds up is no obstacle
        "tool_timeout": 0.5,
        "link_timeout": 3.0,
        "listener_timeout": 0.5,
    }
    if mode == "raw":
        given["following_topic"] = f"{prefix}/following"  # of the stand-in, which says nothing of it
    arguments = parameters(*(f"{name}:={value}" for name, value in given.items()))
    start(processes, f"{arm}_arm_controller", *arguments, **environment)
    return rig
