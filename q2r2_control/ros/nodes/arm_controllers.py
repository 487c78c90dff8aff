"""The arms of this project's cell; a model for the arms of other robots."""

from __future__ import annotations

from typing import Any

from q2r2_control.ros.nodes.base_arm_controller import BaseArmController, run_arms


class LeftArmController(BaseArmController):
    """Drives the left arm's built-in controller, in the frame of its cell."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("left", **kwargs)


class RightArmController(BaseArmController):
    """Drives the right arm's built-in controller, in the frame of its cell."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("right", **kwargs)


def run_both_arms() -> int:
    """Both arms in one process and one teleoperation."""
    return run_arms(LeftArmController, RightArmController)
