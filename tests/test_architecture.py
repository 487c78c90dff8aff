"""The rooms of the package: which may import which, and what none of them may import."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "q2r2_control"

# From the bottom to the top. A room imports only from rooms below it; those that share a line are independent of each
# other.
LEVELS = (
    {"_lazy", "errors", "types", "events"},
    {"wording"},
    {"process", "quaternions"},
    {"config"},
    {"robot"},
    {"inputs", "teleop", "control"},
    {"compliance", "plants"},
    {"drives", "supervision"},
    {"loop"},
    {"summary"},
    {"pipeline"},
    {"viewer", "benchmark", "recording"},
    {"verification", "demo"},
    {"export", "judging"},
    {"ros"},
    {"cli"},
    {"__main__"},
)
ROS_PACKAGES = {
    *("rclpy", "launch", "launch_ros", "ament_index_python", "domain_coordinator", "quest2ros"),
    *("rcl_interfaces", "rosgraph_msgs", "builtin_interfaces", "action_msgs", "std_srvs", "tf2_msgs"),
    *("control_msgs", "diagnostic_msgs", "geometry_msgs", "sensor_msgs", "std_msgs", "trajectory_msgs"),
    "visualization_msgs",
}
CLOCKS_AND_PLANTS = {"time", "socket", "selectors", "threading", "asyncio", "subprocess", "mujoco", "yaml", "rosbags"}
# Measures the solvers that do not tell their own solve time.
ALLOWED = {f"{PACKAGE}.control.qp": {"time"}}
WITHOUT_CLOCK_OR_PLANT = ("control", "teleop", "compliance", "supervision")


def modules() -> dict[str, Path]:
    """Dotted name of every module, without that of its package's ``__init__``."""
    found = {}
    for file in (ROOT / PACKAGE).rglob("*.py"):
        parts = file.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


MODULES = modules()


def room_of(module: str) -> str:
    """The first name below the package; empty for the package itself."""
    return module.split(".")[1] if "." in module else ""


@cache
def imports_of(module: str) -> frozenset[str]:
    """Full names of modules that ``module`` imports when it runs, inside functions too, not for type checkers only."""
    return frozenset(_imported(ast.parse(MODULES[module].read_text(encoding="utf-8"))))


def _imported(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, "imports are absolute"
        assert node.module is not None
        for alias in node.names:
            submodule = f"{node.module}.{alias.name}"
            yield submodule if submodule in MODULES else node.module
    for child in ast.iter_child_nodes(node):
        yield from _imported(child)


def inner_imports(module: str) -> set[str]:
    return {name for name in imports_of(module) if name in MODULES}


def circle_in(graph: Mapping[str, set[str]]) -> list[str]:
    """The nodes of one circle, empty where there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_every_room_has_a_level() -> None:
    assert {room_of(module) for module in MODULES} - {""} == set().union(*LEVELS)


@pytest.mark.parametrize("room", sorted(set().union(*LEVELS)))
def test_a_room_imports_only_from_rooms_below_it(room: str) -> None:
    level = next(index for index, rooms in enumerate(LEVELS) if room in rooms)
    allowed = {room}.union(*LEVELS[:level])
    for module in MODULES:
        if room_of(module) == room:
            against = {name for name in inner_imports(module) if room_of(name) not in allowed}
            assert not against, f"{module} imports {', '.join(sorted(against))}"


def test_no_rooms_and_no_modules_import_each_other_in_a_circle() -> None:
    assert circle_in({module: inner_imports(module) for module in MODULES}) == []
    rooms: dict[str, set[str]] = {}
    for module in MODULES:
        others = {room_of(name) for name in inner_imports(module)} - {room_of(module)}
        rooms.setdefault(room_of(module), set()).update(others)
    assert circle_in(rooms) == []


def test_only_the_nodes_import_ros() -> None:
    for module in MODULES:
        if room_of(module) != "ros":
            assert not {name.split(".")[0] for name in imports_of(module)} & ROS_PACKAGES, module


@pytest.mark.parametrize("room", WITHOUT_CLOCK_OR_PLANT)
def test_the_maths_imports_no_clock_no_socket_no_simulator(room: str) -> None:
    for module in MODULES:
        if room_of(module) == room:
            found = {name.split(".")[0] for name in imports_of(module)} & CLOCKS_AND_PLANTS
            assert found == ALLOWED.get(module, set()), module


HEAVY = (f"{PACKAGE}.control.controller", "mujoco", "numba", "matplotlib")


@pytest.mark.parametrize(
    ("module", "forbidden"),
    [
        pytest.param("ros.bridge.parameters", HEAVY, id="parameters of the teleop nodes"),
        pytest.param("ros.nodes.base_arm_controller", HEAVY, id="a teleop node"),
        pytest.param("ros.nodes.tcp_endpoint", HEAVY, id="the headset's node"),
        pytest.param("teleop", HEAVY, id="teleop"),
        pytest.param("inputs", HEAVY, id="inputs"),
        pytest.param("viewer.topic_table", HEAVY, id="a table of topics"),
        pytest.param("plants", ("mujoco", "numba", "matplotlib"), id="plants"),
        pytest.param("recording.writer", (*HEAVY, f"{PACKAGE}.pipeline"), id="the process that writes recordings"),
        pytest.param("cli.app", ("matplotlib", "rclpy"), id="the command line"),
    ],
)
def test_importing_a_light_module_imports_nothing_heavy(module: str, forbidden: tuple[str, ...]) -> None:
    if module.startswith("ros.") and find_spec("rclpy") is None:
        pytest.skip("rclpy is not installed")
    code = f"import sys, {PACKAGE}.{module}; print(*(name for name in {forbidden!r} if name in sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []


@pytest.mark.parametrize("package", sorted(name for name, file in MODULES.items() if file.name == "__init__.py"))
def test_every_name_that_a_package_exports_exists(package: str) -> None:
    if package.startswith(f"{PACKAGE}.ros") and find_spec("rclpy") is None:
        pytest.skip("rclpy is not installed")
    found = import_module(package)
    for name in getattr(found, "__all__", ()):
        assert hasattr(found, name), name
