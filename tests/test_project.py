"""What the project says of itself: its dependencies are used, the README's code and commands work."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Distributions whose import has another name.
IMPORTS = {"pin": "pinocchio", "example-robot-data-loaders": "example_robot_data", "PyYAML": "yaml", "pin-pink": "pink"}


def dependencies() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return [re.split(r"[<>=]", entry)[0] for entry in project["dependencies"]]


def dependencies_to_compare() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return list(project["optional-dependencies"]["bench"])


def imported() -> set[str]:
    return set().union(*(imported_by(file) for file in (ROOT / "q2r2_control").rglob("*.py")))


def imported_by(file: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names


@pytest.mark.parametrize("dependency", dependencies())
def test_every_dependency_is_imported_by_the_package(dependency: str) -> None:
    assert IMPORTS.get(dependency, dependency) in imported()


def test_everything_that_is_imported_is_a_dependency() -> None:
    # coal comes with pin, glfw with mujoco.
    known = {IMPORTS.get(name, name) for name in dependencies() + dependencies_to_compare()} | {"coal", "glfw"}
    assert imported() - known - set(sys.stdlib_module_names) == {"q2r2_control"}


def test_peers_are_imported_by_their_own_modules_only() -> None:
    peers = {IMPORTS.get(name, name) for name in dependencies_to_compare()}
    for file in (ROOT / "q2r2_control").rglob("*.py"):
        if peers & imported_by(file):
            assert file.parent.name == "peers"
            assert peers & imported_by(file) == {file.stem}


def test_the_code_in_the_readme_runs() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip().endswith("True")


def test_every_file_that_the_readme_names_exists() -> None:
    for path in re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text()):
        assert (ROOT / path).exists(), path


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
