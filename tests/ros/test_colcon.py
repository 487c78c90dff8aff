"""The repository as a ROS package: colcon builds it, and what it installs runs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ros.processes import ROOT

PACKAGE = (
    *("package.xml", "pyproject.toml", "setup.py", "setup.cfg", "README.md", "LICENSE"),
    *("config", "launch", "q2r2_control", "resource", "robots", "views"),
)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace that colcon has built a copy of the repository in."""
    pytest.importorskip("colcon_ros", reason="needs colcon: pip install 'q2r2_control[dev]'")
    folder = tmp_path_factory.mktemp("workspace")
    copy = folder / "src" / "q2r2_control"
    copy.mkdir(parents=True)
    for name in PACKAGE:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        elif (ROOT / name).is_file():
            shutil.copy(ROOT / name, copy)
    colcon = [sys.executable, "-c", "import sys; from colcon_core.command import main; sys.exit(main())"]
    run = subprocess.run(
        [*colcon, "build", "--event-handlers", "console_direct+"],
        cwd=folder,
        env=os.environ | {"PYTHONWARNINGS": "ignore"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return folder


def in_workspace(workspace: Path, command: str) -> str:
    """What a shell prints that has sourced the workspace, run in a folder that holds nothing."""
    elsewhere = workspace / "elsewhere"
    elsewhere.mkdir(exist_ok=True)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    run = subprocess.run(
        ["bash", "-c", f'. "{workspace}/install/local_setup.bash" && {command}'],
        cwd=elsewhere,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


def installed(workspace: Path) -> Path:
    return workspace / "install" / "q2r2_control"


def test_the_command_starts_from_where_ros_looks_for_executables(workspace: Path) -> None:
    help_text = in_workspace(workspace, f'"{installed(workspace)}/lib/q2r2_control/q2r2" --help')
    assert "Bimanual VR teleoperation" in help_text
    assert "build-interfaces" in in_workspace(workspace, f'"{installed(workspace)}/lib/q2r2_control/q2r2" ros --help')


def test_code_settings_and_robots_are_those_of_the_install_tree(workspace: Path) -> None:
    script = "import q2r2_control.config.resources as r; print(r.__file__); print(r.find_resource('robots/iiwa7.urdf'))"
    code, robot = in_workspace(workspace, f'"{sys.executable}" -c "{script}"').splitlines()
    assert Path(code).is_relative_to(installed(workspace) / "lib")
    share = installed(workspace) / "share" / "q2r2_control"
    assert Path(robot) == share / "robots" / "iiwa7.urdf"
    assert (share / "package.xml").is_file()
    shipped = {file.name for folder in ("config", "robots", "launch") for file in (ROOT / folder).glob("*.*")}
    assert {file.name for file in share.glob("*/*.*")} >= shipped


def test_the_interface_packages_are_installed_with_the_code(workspace: Path) -> None:
    def definitions(package: Path) -> set[Path]:
        folder = package / "ros" / "interfaces"
        return {file.relative_to(folder) for file in folder.rglob("*") if file.is_file()}

    (package,) = installed(workspace).glob("lib/python3.*/site-packages/q2r2_control")
    assert definitions(package) == definitions(ROOT / "q2r2_control")
