"""The nodes that teleoperate the arms of this project's cell. They are an example for the arms of other robots."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from q2r2_control.ros.base_node import run_node
from q2r2_control.ros.nodes.base_arm_controller import BaseArmController


class LeftArmController(BaseArmController):
    """Teleoperates the left arm through its built-in controller, with targets in the world frame of the cell."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("left", **kwargs)


class RightArmController(BaseArmController):
    """Teleoperates the right arm through its built-in controller, with targets in the world frame of the cell."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("right", **kwargs)


def run_arms(left: Callable[..., BaseArmController], right: Callable[..., BaseArmController]) -> int:
    """Run an executable with the nodes of both arms, which share one teleoperation."""
    made: list[BaseArmController] = []

    def make_left() -> BaseArmController:
        made.append(left())
        return made[0]

    return run_node(make_left, lambda: right(partner=made[0]))


def run_both_arms() -> int:
    """Run both arms in one process and one teleoperation."""
    return run_arms(LeftArmController, RightArmController)
