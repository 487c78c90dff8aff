"""Optional subpackages can be removed: arms still move with everything that is left.

An optional subpackage, here called a door, is a folder for one kind of devices, formats or programs: ROS, cabinets,
cameras, pages, recordings, exports, tests for others. An import finder that raises for all modules of a folder acts as
if the files were not there. In the same way, it hides the packages of extras, as in an installation without extras.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import pytest

from q2r2_control.extras import PACKAGES, install_line, module_of

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
HIDDEN_DOORS = tuple(f"q2r2_control.{door}" for door in DOORS)
HIDDEN_PACKAGES = tuple(module_of(package) for packages in PACKAGES.values() for package in packages)
WITHOUT = """
import contextlib, io, json, runpy, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        for hidden in HIDDEN:
            if name == hidden or name.startswith(f"{hidden}."):
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

HIDDEN = json.loads(sys.argv[1])
sys.meta_path.insert(0, Absent())
results = []
for arguments in json.loads(sys.argv[2]):
    sys.argv[1:] = arguments
    code, out, err = 0, io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            if arguments[0] == "-c":
                exec(arguments[1], {})
            else:
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


def results(commands: Sequence[tuple[str, ...]], without: tuple[str, ...] = HIDDEN_DOORS) -> list[Result]:
    """Run commands one after the other, in one process that cannot import the modules ``without``.

    A command that begins with -c is Python code instead of arguments of ``q2r2``. An import that fails leaves nothing
    behind, so that no command can use what another one has imported.
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
    """One of the remaining optional subpackages might need the missing one. The demo is too short to succeed."""
    command = ("demo", "grasp", "--fast", "--headless", "--duration", "0.1", "--json")
    (result,) = results([command], without=(f"q2r2_control.{door}",))
    assert result.code == 1, result.stderr
    (task,) = json.loads(result.stdout)["tasks"]
    assert task["reason"].startswith("flat_block: held 95 mm up for 0.0 s")


@pytest.mark.parametrize("command", NEEDS, ids=" ".join)
def test_a_command_that_needs_a_missing_subpackage_names_it_in_one_line(command: tuple[str, ...]) -> None:
    result = without_any_door()[command]
    assert result.code == 2, result.stderr
    assert NEEDS[command] in result.stderr
    assert result.stderr.count("\n") == 1


CHECK, DOCTOR = ("check", "config/dual_iiwa7.yaml"), ("doctor", "--json")
SHORT_RUN = (*RUN[:-1], "0.1")
# This program prints the public names that cannot be used without the packages of an extra.
PUBLIC_NAMES = (
    "-c",
    """
import q2r2_control
for name in q2r2_control.__all__:
    try:
        getattr(q2r2_control, name)
    except q2r2_control.ConfigError:
        print(name)
""",
)
# For each command, the extra that it lacks, and the begin and the end of the message.
LACKS = {
    ("run", "config/dual_iiwa7.yaml"): ("sim", "plant mujoco needs", ", or choose --plant kinematic"),
    ("demo",): ("sim", "q2r2 demo needs", ""),
    ("evaluate", "examples.policy:Circles", "grasp"): ("sim", "q2r2 evaluate needs", ""),
    ("new-cell", "mine", "--left", "a.xml", "--velocity", "1", "--yes"): ("sim", "an MJCF file needs", ""),
    (*SHORT_RUN, "--record", "build"): ("data", "--record needs", ""),
    ("replay", "run.mcap"): ("data", "work with recordings needs", ""),
    (*SHORT_RUN, "--input", "headset"): ("headset", "input headset needs", ""),
    ("headset-check",): ("headset", "the format of hand messages needs", ""),
    (*SHORT_RUN, "--input", "webxr"): ("web", "input webxr needs", ""),
    (*SHORT_RUN, "--web"): ("web", "--web needs", ""),
    ("run", "config/dual_iiwa7_fri.yaml", "--plant", "fri", "--i-know"): ("fri", "plant fri needs", ""),
    ("fri-check", "config/dual_iiwa7_fri.yaml"): ("fri", "the Fast Robot Interface needs", ""),
}


@cache
def without_any_extra() -> dict[tuple[str, ...], Result]:
    """Return the result of each command without the packages of extras. The imports take most of the time."""
    commands = [HELP, CHECK, DOCTOR, *LACKS, SHORT_RUN, PUBLIC_NAMES]
    return dict(zip(commands, results(commands, without=HIDDEN_PACKAGES), strict=True))


def test_arms_run_without_any_extra() -> None:
    for command in (HELP, SHORT_RUN):
        result = without_any_extra()[command]
        assert result.code == 0, result.stderr
    assert "certified" in without_any_extra()[SHORT_RUN].stdout


def test_a_cell_whose_simulation_is_not_installed_can_be_checked_and_a_note_says_so() -> None:
    result = without_any_extra()[CHECK]
    assert result.code == 0, result.stderr
    assert "this cell can run" in result.stdout
    assert f"NOTE not checked: plant mujoco needs mujoco and pillow: {install_line('sim')}" in result.stdout


def test_the_doctor_says_that_the_simulation_of_the_cell_is_missing() -> None:
    result = without_any_extra()[DOCTOR]
    found = json.loads(result.stdout)
    assert (result.code, found["lacks"]) == (1, True), result.stderr
    (missing,) = (finding for finding in found["findings"] if finding["stops_arms"])
    assert missing["what"] == "plant mujoco needs mujoco and pillow"
    assert missing["cure"] == f"{install_line('sim')}, or choose --plant kinematic"


def test_only_public_names_of_datasets_need_an_extra() -> None:
    result = without_any_extra()[PUBLIC_NAMES]
    assert result.stdout.split() == ["EpisodeVectors", "ExportFormat"]


@pytest.mark.parametrize("command", LACKS, ids=" ".join)
def test_a_command_that_needs_an_extra_names_it_in_one_line(command: tuple[str, ...]) -> None:
    result, (extra, begin, end) = without_any_extra()[command], LACKS[command]
    assert result.code == 2, result.stderr
    assert result.stderr.startswith(f"q2r2: {begin} ")
    assert result.stderr.endswith(f": {install_line(extra)}{end}\n")
    assert result.stderr.count("\n") == 1
