"""Both arms of this project's cell in one process and one teleoperation."""

from __future__ import annotations

import sys

from q2r2_control.ros.nodes.base_arm_controller import run_arms
from q2r2_control.ros.nodes.left_arm_controller import LeftArmController
from q2r2_control.ros.nodes.right_arm_controller import RightArmController


def main() -> int:
    """The executable."""
    return run_arms(LeftArmController, RightArmController)


if __name__ == "__main__":
    sys.exit(main())
