"""The left arm of this project's cell; a model for the arms of other robots."""

from __future__ import annotations

import sys
from typing import Any

from q2r2_control.ros.base_node import run_node
from q2r2_control.ros.nodes.base_arm_controller import BaseArmController


class LeftArmController(BaseArmController):
    """Drives the left arm's built-in controller, in the frame of its cell."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            arm_name="left",
            robot_name="q2r2",
            base_frame_id="world",
            end_effector_link_name="left_tool_frame",
            ctrl_prefix="/q2r2/left",
            gripper_action_topic="/q2r2/left_gripper/gripper_cmd",
            **kwargs,
        )


def main() -> int:
    """The executable."""
    return run_node(LeftArmController)


if __name__ == "__main__":
    sys.exit(main())
