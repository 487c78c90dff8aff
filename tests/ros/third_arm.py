"""An arm of another robot, ported as a user would: ``python -m tests.ros.third_arm``."""

from __future__ import annotations

import sys
from typing import Any

from q2r2_control.ros.base_node import run_node
from q2r2_control.ros.nodes.base_arm_controller import BaseArmController


class ThirdArmController(BaseArmController):
    def __init__(self, **kwargs: Any) -> None:
        super().__init__(
            arm_name="right",
            robot_name="bh_robot",
            mirror=True,
            base_frame_id="bh_robot_base",
            filter_window_size=4,
            end_effector_link_name="right_arm_link_ee",
            ctrl_prefix="/bh_robot/right_arm_clik_controller",
            gripper_action_topic="/bh_robot/right_arm_gripper_action_controller/gripper_cmd",
            **kwargs,
        )


def main() -> int:
    return run_node(ThirdArmController)


if __name__ == "__main__":
    sys.exit(main())
