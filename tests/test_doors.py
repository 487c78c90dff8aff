"""Optional subpackages can be removed: arms still move with everything that is left.

An optional subpackage, here called a door, is a folder for one kind of devices, formats or programs: ROS, cabinets,
cameras, pages, recordings, exports, tests for others. An import finder that raises for all modules of a folder acts as
if the files were not there.
"""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

DOORS = (
    "benchmark",
    "cameras",
    "export",
    "gym",
    "inputs.webxr",
    "judging",
    "plants.fri",
    "process.cluster",
    "recording",
    "ros",
    "verification",
    "viewer.web",
)
WITHOUT = """
import runpy, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        for door in DOORS:
            if name == door or name.startswith(f"{door}."):
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

DOORS = [f"q2r2_control.{door}" for door in sys.argv.pop(1).split(",")]
sys.meta_path.insert(0, Absent())
runpy.run_module("q2r2_control", run_name="__main__", alter_sys=True)
"""


def q2r2(*arguments: str, without: tuple[str, ...] = DOORS) -> subprocess.CompletedProcess[str]:
    """Run a command in a process that cannot import the subpackages ``without``."""
    return subprocess.run(
        [sys.executable, "-c", WITHOUT, ",".join(without), *arguments], capture_output=True, text=True, check=False
    )


def test_the_help_lists_all_commands_without_any_optional_subpackage() -> None:
    result = q2r2("--help")
    assert result.returncode == 0, result.stderr
    assert "demo" in result.stdout


def test_arms_run_without_any_optional_subpackage() -> None:
    cell = "config/dual_iiwa7.yaml"
    result = q2r2("run", cell, "--plant", "kinematic", "--fast", "--headless", "--duration", "1.5")
    assert result.returncode == 0, result.stderr
    assert "certified" in result.stdout, result.stdout


@pytest.mark.slow
def test_the_demo_succeeds_without_any_optional_subpackage() -> None:
    result = q2r2("demo", "grasp", "--fast", "--headless")
    assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("door", DOORS)
def test_a_demo_runs_to_its_judge_without_one_optional_subpackage(door: str) -> None:
    """Another optional subpackage that is still there may need the missing one. The demo is too short to succeed."""
    result = q2r2("demo", "grasp", "--fast", "--headless", "--duration", "0.1", "--json", without=(door,))
    assert result.returncode == 1, result.stderr
    (task,) = json.loads(result.stdout)["tasks"]
    assert task["reason"].startswith("flat_block: held 95 mm up for 0.0 s")


@pytest.mark.parametrize(
    ("arguments", "missing"),
    [
        (("run", "config/dual_iiwa7_fri.yaml", "--plant", "fri"), "q2r2_control.plants.fri"),
        (("run", "config/dual_iiwa7.yaml", "--web"), "q2r2_control.viewer.web"),
        (("ros", "up", "config/dual_iiwa7.yaml"), "q2r2_control.ros"),
        (("fri-check", "config/dual_iiwa7_fri.yaml"), "q2r2_control.plants.fri"),
        (("export", "csv", "run.mcap"), "q2r2_control.export"),
        (("run", "config/dual_iiwa7.yaml", "--record", "build"), "q2r2_control.judging"),
    ],
)
def test_a_command_that_needs_a_missing_subpackage_names_it_in_one_line(
    arguments: tuple[str, ...], missing: str
) -> None:
    result = q2r2(*arguments)
    assert result.returncode == 2, result.stderr
    assert missing in result.stderr
    assert result.stderr.count("\n") == 1
