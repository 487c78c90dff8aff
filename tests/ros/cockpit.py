"""Two hands that move the simulated arms through all their nodes. Tests kill, freeze and restart these nodes."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Mapping
from typing import Any

from q2r2_control import Robot
from tests.ros.arm_rig import ArmRig, ArmRigs, patient
from tests.ros.cell import PATIENT, Cell, start_controller, start_robot
from tests.ros.processes import Processes, RosProcess, wait_until

ROBOT, CONTROLLER, ARMS = "mujoco_robot", "cartesian_controller", "arm_controllers"


class Cockpit:
    def __init__(self, node: Any, robot: Robot, processes: Processes, parameters: Mapping[str, Any]) -> None:
        self._starts: dict[str, Callable[[], RosProcess]] = {
            # The robot does not refuse a jump of its commands, so that tests see the jump.
            ROBOT: lambda: start_robot(processes, "max_jump:=1.0"),
            CONTROLLER: lambda: start_controller(processes, *PATIENT),
            ARMS: lambda: processes.start_node(ARMS, *patient(parameters)),
        }
        self.running = {name: start() for name, start in self._starts.items()}
        self.cell = Cell(node, robot, targets="/not_used/{arm}")  # The targets come from the nodes of the arms.
        self.left, self.right = (ArmRig(node, arm, answers=False) for arm in ("left", "right"))
        self.rigs = ArmRigs([self.left, self.right])
        for rig in self.rigs.rigs:
            rig.sends_tool = rig.follows = False
        self.wait_until_up()

    def wait_until_up(self) -> None:
        self.rigs.wait(lambda rig: rig.state.get("hand_age") is not None, "its node receives the hand")
        wait_until(lambda: self.cell.state("phase") == "active", "the controller is active", lambda: self.cell.states)

    def signal(self, name: str, number: signal.Signals) -> float:
        sent = time.monotonic()
        os.kill(self.running[name].pid, number)
        if number is signal.SIGKILL:
            self.running[name].wait()
        return sent

    def restart(self, name: str) -> None:
        """Restart the robot or controller after a kill. Its earlier states do not count any more."""
        self.cell.states.pop(name, None)
        self.running[name] = self._starts[name]()

    def go_home(self) -> None:
        """Let the simulation put the arms at home, at rest and not engaged."""
        self.cell.stop_and_reset(at_home=True)
        self.wait_until_up()
        self.rigs.wait(lambda rig: not rig.state["engaged"], "no arm is engaged")
