"""What the project says of itself: its dependencies are used, the README's code and commands work."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROS = ROOT / "q2r2_control" / "ros"
# Distributions whose import has another name.
IMPORTS = {
    **{"pin": "pinocchio", "example-robot-data-loaders": "example_robot_data", "PyYAML": "yaml", "pin-pink": "pink"},
    "pillow": "PIL",
}


def project() -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return table


def distribution(entry: str) -> str:
    """Name of what an entry of a list of dependencies asks for."""
    return re.split(r"[<>=]", entry)[0]


def dependencies() -> list[str]:
    return list(map(distribution, project()["dependencies"]))


def dependencies_to_compare() -> set[str]:
    """Modules of the public controllers that the bench knows."""
    return {IMPORTS.get(name, name) for name in project()["optional-dependencies"]["bench"]}


def modules_of_dependencies() -> set[str]:
    # coal comes with pin, glfw with mujoco.
    return {IMPORTS.get(name, name) for name in dependencies()} | {"coal", "glfw"}


def modules_of_formats() -> set[str]:
    """What is imported only where a model has another format than URDF, or a dataset is written."""
    extras = project()["optional-dependencies"]
    return set(map(distribution, extras["xacro"] + extras["export"] + extras["ray"]))


def modules_of_ros() -> set[str]:
    """What the extra ros brings, and the interface packages that ship as source."""
    registry = {
        entry.removeprefix("ros-jazzy-").replace("-", "_") for entry in project()["optional-dependencies"]["ros"]
    }
    return registry | {file.parent.name for file in (ROS / "interfaces").glob("*/package.xml")}


@cache
def imported_by(file: Path) -> frozenset[str]:
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return frozenset(names - set(sys.stdlib_module_names) - {"q2r2_control"})


def imported(files: Iterable[Path]) -> set[str]:
    return {name for file in files for name in imported_by(file)}


def modules_outside_ros() -> set[Path]:
    return set((ROOT / "q2r2_control").rglob("*.py")) - modules_of_nodes()


def modules_of_nodes() -> set[Path]:
    """Modules that need rclpy."""
    return set(ROS.rglob("*.py"))


@pytest.mark.parametrize("dependency", dependencies())
def test_every_dependency_is_imported_by_the_package(dependency: str) -> None:
    assert IMPORTS.get(dependency, dependency) in imported(modules_outside_ros())


def test_everything_that_is_imported_outside_ros_is_a_dependency() -> None:
    optional = dependencies_to_compare() | modules_of_formats()
    assert imported(modules_outside_ros()) - modules_of_dependencies() - optional == set()


def test_everything_that_the_nodes_import_is_a_dependency_or_in_the_extra_ros() -> None:
    assert imported(modules_of_nodes()) - modules_of_dependencies() - modules_of_ros() == set()


def test_the_ros_manifest_has_the_name_and_version_of_the_python_package() -> None:
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    assert manifest.findtext("name") == project()["name"]
    assert manifest.findtext("version") == project()["version"]


def test_peers_are_imported_by_their_own_modules_only() -> None:
    peers = dependencies_to_compare()
    for file in (ROOT / "q2r2_control").rglob("*.py"):
        if peers & imported([file]):
            assert file.parent.name == "peers"
            assert peers & imported([file]) == {file.stem}


def test_the_code_in_the_readme_runs() -> None:
    # What needs ROS is started by tests/ros.
    _, code = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip().endswith("True")


def test_every_file_that_the_readme_names_exists() -> None:
    for path in re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / path).exists(), path


@pytest.mark.slow
def test_every_command_that_the_readme_names_exists() -> None:
    commands = set(re.findall(r"q2r2 ([a-z]+(?:-[a-z]+)?)", (ROOT / "README.md").read_text()))
    assert commands >= {"demo", "run", "check", "headset-check", "bench"}
    for command in commands:
        result = subprocess.run(
            [sys.executable, "-m", "q2r2_control", command, "--help"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert result.returncode == 0, result.stderr
