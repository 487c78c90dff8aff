"""Two hands that drive the simulated arms through all their nodes."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from q2r2_control import Robot
from tests.ros.arm_rig import ArmRig, ArmRigs, patient
from tests.ros.cell import PATIENT, Cell, start_controller, start_robot
from tests.ros.processes import Processes
from tests.ros.waiting import wait_until


class Cockpit:
    """Two hands that drive the simulated arms through their nodes."""

    def __init__(
        self, node: Any, robot: Robot, processes: Processes, bindings: Mapping[str, str], apart: bool = False
    ) -> None:
        """``apart``: each arm's node is a process of its own."""
        nodes = start_robot(processes), start_controller(processes, *PATIENT)
        self.cell = Cell(node, robot, *nodes, targets="/not_used/{arm}")  # the arms' nodes publish targets
        self.left, self.right = ArmRig(node, "left"), ArmRig(node, "right")
        self.rigs = ArmRigs([self.left, self.right])
        for rig in self.rigs.rigs:
            rig.sends_tool = rig.follows = False
        names = ("left_arm_controller", "right_arm_controller") if apart else ("arm_controllers",)
        self.arms = [processes.start_node(name, *patient(bindings)) for name in names]
        self.rigs.wait(lambda rig: rig.state.get("hand_age") is not None, "its node receives the hand")
        wait_until(lambda: self.cell.state("phase") == "active", "the controller is active")

    def go_away(self) -> None:
        """Both arms are moved a way from home by their hands."""
        self.rigs.engage()
        if self.from_home < 0.1:
            self.rigs.move((0.1, 0.0, 0.08), 1.0)
        states = lambda: [rig.state for rig in self.rigs.rigs]  # noqa: E731
        wait_until(lambda: self.from_home > 0.1, "the arms are away from home", states)

    @property
    def from_home(self) -> float:
        return float(np.abs(self.cell.q - self.cell.robot.home).max())

    def ask_for_home(self) -> None:
        """By the left hand."""
        self.left.grip = 1.0
        self.rigs.wait(lambda rig: rig.state["state"] == "homing", "both arms are on their way home")
        self.left.grip = 0.0

    def hold_lower(self, rig: ArmRig) -> None:
        rig.lower = True
        time.sleep(1.0)
        rig.lower = False

    def hold_upper(self, rig: ArmRig) -> None:
        rig.upper = True
        time.sleep(1.0)
        rig.upper = False
