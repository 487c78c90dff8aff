"""The README's port of another robot starts, and ends in order."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import PATIENCE, ROOT, Processes
from tests.ros.waiting import States

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytestmark = pytest.mark.usefixtures("interfaces")


def test_the_subclass_in_the_readme_is_a_node_that_waits_paused(
    processes: Processes, node: Any, tmp_path: Path
) -> None:
    code, _ = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (file := tmp_path / "right_arm.py").write_text(code)
    states = States(node, "right_bh_robot_arm_controller")
    process = processes.start(sys.executable, str(file), name="right_arm")
    assert states.wait_for("no transform from right_arm_link_ee to bh_robot_base")["state"] == "paused"
    assert process.interrupt(PATIENCE) == 0
