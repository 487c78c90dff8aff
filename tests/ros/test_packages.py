"""The names that ``q2r2_control.ros`` exports, and what importing it costs."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.ros.processes import ROOT


def test_importing_the_package_imports_no_rclpy() -> None:
    code = "import sys, q2r2_control.ros.launch.processes; print('rclpy' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (run.stdout, run.stderr) == ("False\n", "")


def test_the_names_that_subclasses_need_come_from_the_package() -> None:
    pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
    from q2r2_control.ros import BaseArmController, BaseNode, run_node

    assert issubclass(BaseArmController, BaseNode)
    assert callable(run_node)
    with pytest.raises(ImportError):
        from q2r2_control.ros import no_such_name  # noqa: F401
