"""Both arms of this project's cell as two nodes in one process, which takes less of the processors than two do."""

from __future__ import annotations

import sys

from q2r2_control.ros.base_node import run_nodes
from q2r2_control.ros.nodes.left_arm_controller import LeftArmController
from q2r2_control.ros.nodes.right_arm_controller import RightArmController


def main() -> int:
    """The executable."""
    return run_nodes([LeftArmController, RightArmController])


if __name__ == "__main__":
    sys.exit(main())
