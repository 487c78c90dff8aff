"""Beyond the rules of ``lint-imports``: modules import each other in no circle, and light ones stay light."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "q2r2_control"
HEAVY = (f"{PACKAGE}.control.controller", "mujoco", "numba", "matplotlib")


def modules() -> dict[str, Path]:
    """Dotted name of every module, without that of its package's ``__init__``."""
    found = {}
    for file in (ROOT / PACKAGE).rglob("*.py"):
        parts = file.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imported(node: ast.AST) -> Iterator[str]:
    """Names that are imported when a module runs, inside functions too, not for type checkers only."""
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
        yield from imported(child)


def test_no_modules_import_each_other_in_a_circle() -> None:
    known = modules()
    graph = {
        name: {other for other in imported(ast.parse(file.read_text(encoding="utf-8"))) if other in known}
        for name, file in known.items()
        if file.name != "__init__.py"  # an import of a module is one of its package too
    }
    TopologicalSorter(graph).prepare()  # raises CycleError


@pytest.mark.parametrize(
    ("module", "forbidden"),
    [
        pytest.param("ros.bridge.parameters", HEAVY, id="parameters of the teleop nodes"),
        pytest.param("ros.nodes.base_arm_controller", HEAVY, id="a teleop node"),
        pytest.param("ros.nodes.tcp_endpoint", HEAVY, id="the headset's node"),
        pytest.param("teleop", HEAVY, id="teleop"),
        pytest.param("inputs", HEAVY, id="inputs"),
        pytest.param("viewer.headset_table", HEAVY, id="a table of topics"),
        pytest.param("plants", ("mujoco", "numba", "matplotlib"), id="plants"),
        pytest.param("recording.writer", (*HEAVY, f"{PACKAGE}.pipeline"), id="the process that writes recordings"),
        pytest.param("cli.app", ("matplotlib", "rclpy"), id="the command line"),
    ],
)
def test_importing_a_light_module_imports_nothing_heavy(module: str, forbidden: tuple[str, ...]) -> None:
    if module.startswith("ros.") and find_spec("rclpy") is None:
        pytest.skip("rclpy is not installed")
    code = f"import sys, {PACKAGE}.{module}; print(*(name for name in {forbidden!r} if name in sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []


@pytest.mark.parametrize("package", [PACKAGE, f"{PACKAGE}.ros"])
def test_every_public_name_exists(package: str) -> None:
    if package.endswith(".ros") and find_spec("rclpy") is None:
        pytest.skip("rclpy is not installed")
    found = import_module(package)
    for name in found.__all__:
        assert hasattr(found, name), name
