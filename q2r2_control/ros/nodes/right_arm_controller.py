"""The right arm of this project's cell; a model for the arms of other robots."""

from __future__ import annotations

import sys
from typing import Any

from q2r2_control.ros.base_node import run_node
from q2r2_control.ros.nodes.base_arm_controller import BaseArmController


class RightArmController(BaseArmController):
    """Drives the right arm's built-in controller, in the frame of its cell."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            arm_name="right",
            robot_name="q2r2",
            base_frame_id="world",
            end_effector_link_name="right_tool_frame",
            ctrl_prefix="/q2r2/right",
            gripper_action_topic="/q2r2/right_gripper/gripper_cmd",
            **kwargs,
        )


def main() -> int:
    """The executable."""
    return run_node(RightArmController)


if __name__ == "__main__":
    sys.exit(main())
