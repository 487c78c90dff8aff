"""Imports follow the rules and dependencies of the project, and the documentation is current.

These tests go beyond the rules of ``lint-imports``: no modules import each other in a circle, and importing a light
module imports nothing heavy.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from functools import cache
from graphlib import TopologicalSorter
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.support.modules import ROOT, load_script

PACKAGE = "q2r2_control"
HEAVY = (f"{PACKAGE}.control.controller", "mujoco", "numba", "matplotlib")
ROS = ROOT / PACKAGE / "ros"
# Some distributions have another name than the module that they install.
IMPORTS = {
    **{"pin": "pinocchio", "example-robot-data-loaders": "example_robot_data", "PyYAML": "yaml", "pin-pink": "pink"},
    "pillow": "PIL",
    "protobuf": "google",
    "opencv-python-headless": "cv2",
}
# These packages come with pin, mujoco, lerobot and pydantic.
WITH_OTHERS = {"coal", "glfw", "datasets", "pandas", "pydantic_core"}
NODES = set(ROS.rglob("*.py"))
OTHERS = set((ROOT / PACKAGE).rglob("*.py")) - NODES
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *ROOT.glob("[qb]*/**/*.md")])
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def modules(*extras: str) -> set[str]:
    """Return the import names of the project's dependencies, or of the packages in the given extras.

    An extra may name other extras, as in ``q2r2_control[sim,data]``. Their packages are then included.
    """
    optional = PROJECT["optional-dependencies"]
    entries = [entry for extra in extras for entry in optional[extra]] if extras else PROJECT["dependencies"]
    own = [entry for entry in entries if entry.startswith(f"{PACKAGE}[")]
    names = [re.split(r"[\[<>=]", entry)[0].removeprefix("ros-jazzy-") for entry in entries if entry not in own]
    found = {IMPORTS.get(name, name).replace("-", "_") for name in names}
    others = [extra for entry in own for extra in re.findall(r"\w+", entry.removeprefix(PACKAGE))]
    return found | modules(*others) if others else found


def names_imported(node: ast.AST) -> Iterator[str]:
    """Return the names that a module imports, also inside functions. Imports for type checkers only are left out."""
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, "imports are absolute"
        assert node.module is not None
        yield node.module
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    for child in ast.iter_child_nodes(node):
        yield from names_imported(child)


@cache
def imported_by(file: Path) -> frozenset[str]:
    return frozenset(names_imported(ast.parse(file.read_text(encoding="utf-8"))))


def imported(files: Iterable[Path]) -> set[str]:
    """Return the top-level packages that ``files`` import, without the standard library and this package."""
    names = {name.partition(".")[0] for file in files for name in imported_by(file)}
    return names - set(sys.stdlib_module_names) - {PACKAGE}


def test_every_dependency_is_imported_and_every_import_is_a_dependency() -> None:
    doors = modules("sim", "data", "headset", "fri")
    optional = modules("bench", "xacro", "export", "gym", "lerobot", "modbus", "web", "cameras", "realsense", "cluster")
    assert modules() | doors <= imported(OTHERS)
    assert imported(OTHERS) - modules() - doors - optional - WITH_OTHERS == set()
    built = {file.parent.name for file in (ROS / "interfaces").glob("*/package.xml")}
    assert imported(NODES) - modules() - modules("ros") - built - WITH_OTHERS == set()


def test_peers_are_imported_only_by_their_own_modules() -> None:
    for file in OTHERS:
        if found := (modules("bench") - modules("sim")) & imported([file]):
            assert (file.parent.name, found) == ("peers", {file.stem})


def test_the_ros_manifest_has_the_name_and_version_of_the_python_package() -> None:
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    assert manifest.findtext("name") == PROJECT["name"]
    assert manifest.findtext("version") == PROJECT["version"]


def test_no_modules_import_each_other_in_a_circle() -> None:
    files = [
        file for file in OTHERS | NODES if file.name != "__init__.py"
    ]  # Importing a module also imports its package, so packages are left out.
    known = {".".join(file.relative_to(ROOT).with_suffix("").parts): file for file in files}
    graph = {name: imported_by(file) & known.keys() for name, file in known.items()}
    TopologicalSorter(graph).prepare()  # This call raises CycleError if modules import each other in a circle.


@pytest.mark.parametrize(
    "modules_and_forbidden",
    [
        pytest.param(
            {
                "viewer.headset_table": HEAVY,
                "recording.writer": (*HEAVY, f"{PACKAGE}.pipeline", "cv2"),
                "inputs": HEAVY,
                "teleop": HEAVY,
                "plants": ("mujoco", "numba", "matplotlib"),
                "demo.assembly_tasks": ("mujoco",),
                "viewer.headset_display": ("mujoco",),
                "viewer.web.exchange": ("mujoco",),
            },
            id="parts of a loop, and programs that only draw",
        ),
        pytest.param(
            dict.fromkeys(("ros.bridge.parameters", "ros.nodes.tcp_endpoint", "ros.nodes.base_arm_controller"), HEAVY),
            id="nodes",
        ),
        pytest.param(
            {
                "cli.run": ("mujoco", "rosbags", "PIL", "matplotlib", "rclpy"),
                "cli.run_recording": ("cv2",),
                "cli.cameras": ("cv2",),
            },
            id="commands that run a cell, record it or list cameras",
        ),
    ],
)
def test_importing_a_light_module_imports_nothing_heavy(modules_and_forbidden: dict[str, tuple[str, ...]]) -> None:
    """One process imports the modules one after the other. The first entry names the module that imports too much."""
    if "ros.bridge.parameters" in modules_and_forbidden and find_spec("rclpy") is None:
        pytest.skip("rclpy is not installed")
    code = f"""
import importlib, sys
for module, forbidden in {modules_and_forbidden!r}.items():
    importlib.import_module("{PACKAGE}." + module)
    print(*(f"{{module}}:{{name}}" for name in forbidden if name in sys.modules))
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []


def test_make_and_pip_refuse_the_same_versions_of_python() -> None:
    (bounds,) = re.findall(r'python_requires=">=3\.(\d+),<3\.(\d+)"', (ROOT / "setup.py").read_text())
    makefile = (ROOT / "Makefile").read_text()
    assert "not (3, {}) <= v[:2] < (3, {})".format(*bounds) in makefile
    assert f"needs Python 3.{bounds[0]} to 3.{int(bounds[1]) - 1}," in makefile


def test_the_configuration_reference_agrees_with_the_settings() -> None:
    made = load_script("docs/make_reference.py")
    assert made.FILE.read_text(encoding="utf-8") == made.reference(), "python docs/make_reference.py"


def test_no_two_public_classes_have_the_same_name() -> None:
    found = [name for path in NODES | OTHERS for name in re.findall(r"^class ([A-Z]\w*)", path.read_text(), re.M)]
    assert {name for name in found if found.count(name) > 1} == set()


@cache
def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_every_link_of_a_page_leads_to_a_file_and_a_heading(page: Path) -> None:
    for link in re.findall(r"\]\((?!https?:|mailto:)([^)\s]+)", page.read_text(encoding="utf-8")):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_the_page_about_ros_names_every_parameter_that_a_node_declares() -> None:
    page = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8")
    sources = [file.read_text(encoding="utf-8") for file in (ROOT / PACKAGE / "ros").rglob("*.py")]
    declared = {name for text in sources for name in re.findall(r'(?:parameter|declare)\(\s*"([a-z_.]+)"', text)}
    assert "trajectory" in declared
    assert {name for name in declared if f"`{name}`" not in page} == set()
