"""The project's lists of dependencies are those of its imports."""

from __future__ import annotations

import ast
import re
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
WITH_OTHERS = {"coal", "glfw", "datasets"}  # come with pin, mujoco and lerobot
NODES = set(ROS.rglob("*.py"))
OTHERS = set((ROOT / "q2r2_control").rglob("*.py")) - NODES


def project() -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return table


def modules(*extras: str) -> set[str]:
    """What the dependencies, or these extras, bring."""
    optional = project()["optional-dependencies"]
    entries = [entry for extra in extras for entry in optional[extra]] if extras else project()["dependencies"]
    names = [re.split(r"[<>=]", entry)[0].removeprefix("ros-jazzy-") for entry in entries]
    return {IMPORTS.get(name, name).replace("-", "_") for name in names}


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


@pytest.mark.parametrize("dependency", sorted(modules()))
def test_every_dependency_is_imported_by_the_package(dependency: str) -> None:
    assert dependency in imported(OTHERS)


def test_everything_that_is_imported_outside_ros_is_a_dependency() -> None:
    optional = modules("bench", "xacro", "export", "lerobot")
    assert imported(OTHERS) - modules() - optional - WITH_OTHERS == set()


def test_everything_that_the_nodes_import_is_a_dependency_or_in_the_extra_ros() -> None:
    built = {file.parent.name for file in (ROS / "interfaces").glob("*/package.xml")}
    assert imported(NODES) - modules() - modules("ros") - built - WITH_OTHERS == set()


def test_peers_are_imported_by_their_own_modules_only() -> None:
    for file in OTHERS:
        if found := modules("bench") & imported([file]):
            assert (file.parent.name, found) == ("peers", {file.stem})


def test_the_ros_manifest_has_the_name_and_version_of_the_python_package() -> None:
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    assert manifest.findtext("name") == project()["name"]
    assert manifest.findtext("version") == project()["version"]
