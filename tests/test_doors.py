"""Optional subpackages can be removed: arms still move with everything that is left.

An optional subpackage, here called a door, is a folder for one kind of devices, formats or programs: ROS, cabinets,
cameras, pages, recordings, exports, tests for others. An import finder that raises for all modules of a folder acts as
if the files were not there.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

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
import contextlib, io, json, runpy, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        for door in DOORS:
            if name == door or name.startswith(f"{door}."):
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

DOORS = [f"q2r2_control.{door}" for door in json.loads(sys.argv[1])]
sys.meta_path.insert(0, Absent())
results = []
for arguments in json.loads(sys.argv[2]):
    sys.argv[1:] = arguments
    code, out, err = 0, io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            runpy.run_module("q2r2_control", run_name="__main__", alter_sys=True)
        except SystemExit as end:
            code = end.code or 0
    results.append((code, out.getvalue(), err.getvalue()))
print(json.dumps(results))
"""


class Result(NamedTuple):
    code: int
    stdout: str
    stderr: str


def results(commands: Sequence[tuple[str, ...]], without: tuple[str, ...] = DOORS) -> list[Result]:
    """Run commands one after the other, in one process that cannot import the subpackages ``without``.

    An import that fails leaves nothing behind, so that no command can use what another one has imported.
    """
    process = subprocess.run(
        [sys.executable, "-c", WITHOUT, json.dumps(without), json.dumps(commands)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return [Result(*result) for result in json.loads(process.stdout)]


HELP = ("--help",)
RUN = (
    *("run", "config/dual_iiwa7.yaml", "--plant", "kinematic"),
    *("--fast", "--headless", "--duration", "1.5"),
)
# The subpackages that these commands need, and that are missing.
NEEDS = {
    ("run", "config/dual_iiwa7_fri.yaml", "--plant", "fri"): "q2r2_control.plants.fri",
    ("run", "config/dual_iiwa7.yaml", "--web"): "q2r2_control.viewer.web",
    ("ros", "up", "config/dual_iiwa7.yaml"): "q2r2_control.ros",
    ("fri-check", "config/dual_iiwa7_fri.yaml"): "q2r2_control.plants.fri",
    ("export", "csv", "run.mcap"): "q2r2_control.export",
    ("run", "config/dual_iiwa7.yaml", "--record", "build"): "q2r2_control.judging",
}


@cache
def without_any_door() -> dict[tuple[str, ...], Result]:
    """Return the result of each command without any optional subpackage. The imports take most of the time."""
    commands = [HELP, *NEEDS, RUN]
    return dict(zip(commands, results(commands), strict=True))


def test_the_help_lists_all_commands_without_any_optional_subpackage() -> None:
    result = without_any_door()[HELP]
    assert result.code == 0, result.stderr
    assert "demo" in result.stdout


def test_arms_run_without_any_optional_subpackage() -> None:
    result = without_any_door()[RUN]
    assert result.code == 0, result.stderr
    assert "certified" in result.stdout, result.stdout


@pytest.mark.slow
def test_the_demo_succeeds_without_any_optional_subpackage() -> None:
    (result,) = results([("demo", "grasp", "--fast", "--headless")])
    assert result.code == 0, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("door", DOORS)
def test_a_demo_runs_to_its_judge_without_one_optional_subpackage(door: str) -> None:
    """Another optional subpackage that is still there may need the missing one. The demo is too short to succeed."""
    command = ("demo", "grasp", "--fast", "--headless", "--duration", "0.1", "--json")
    (result,) = results([command], without=(door,))
    assert result.code == 1, result.stderr
    (task,) = json.loads(result.stdout)["tasks"]
    assert task["reason"].startswith("flat_block: held 95 mm up for 0.0 s")


@pytest.mark.parametrize("command", NEEDS, ids=" ".join)
def test_a_command_that_needs_a_missing_subpackage_names_it_in_one_line(command: tuple[str, ...]) -> None:
    result = without_any_door()[command]
    assert result.code == 2, result.stderr
    assert NEEDS[command] in result.stderr
    assert result.stderr.count("\n") == 1
