"""The public API: each name is documented and cheap to import, and plug-ins and examples need no other name."""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec, resolve_name
from pathlib import Path

import pytest

from tests.support.modules import ROOT, blocks_of

PACKAGE = "q2r2_control"
ENTRIES = re.findall(r"^::: (\S+)$", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
PACKAGES = sorted({entry.rpartition(".")[0] for entry in ENTRIES})
NEEDED = {f"{PACKAGE}.gym": "gymnasium", f"{PACKAGE}.ros": "rclpy"}  # The module that some names of a subpackage need.
HEAVY = ("numba", "pinocchio", "mujoco", "scipy", "rclpy", "numpy", "matplotlib", "pydantic")
CLIENTS = sorted(file for folder in ("plugins", "examples") for file in (ROOT / folder).rglob("*.py"))
# Kernels are a part of the package itself, so their page imports inner modules.
PAGES = sorted(page for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")] if page.name != "kernels.md")
EACH_PACKAGE = pytest.mark.parametrize("package", PACKAGES)


def names_on_the_page(package: str) -> list[str]:
    """Return the names of a package that the page of the API documents."""
    return sorted(entry.rpartition(".")[2] for entry in ENTRIES if entry.rpartition(".")[0] == package)


def inner_imports(code: str, where: str) -> Iterator[str]:
    """Yield a line for each name that ``code`` imports from this package although the name is not public."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            imported = [("", alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            imported = [(node.module, alias.name) for alias in node.names]
        else:
            continue
        for module, name in imported:
            inside = (module or name).partition(".")[0] == PACKAGE
            if inside and f"{module}.{name}" not in ENTRIES:
                public = [entry for entry in ENTRIES if entry.rpartition(".")[2] == name]
                allowed = f"from {public[0].rpartition('.')[0]} import {name}" if public else "the names in docs/api.md"
                found = f"from {module} import {name}" if module else f"import {name}"
                yield f"{where}:{node.lineno}: {found}; allowed: {allowed}"


@pytest.mark.parametrize("file", CLIENTS, ids=[str(file.relative_to(ROOT)) for file in CLIENTS])
def test_plugins_and_examples_import_public_names_only(file: Path) -> None:
    found = inner_imports(file.read_text(encoding="utf-8"), str(file.relative_to(ROOT)))
    assert not (lines := list(found)), "\n".join(lines)


@pytest.mark.parametrize("page", PAGES, ids=[page.name for page in PAGES])
def test_the_code_on_a_page_imports_public_names_only(page: Path) -> None:
    name = str(page.relative_to(ROOT))
    found = (line for code in blocks_of(name, "python") for line in inner_imports(code, f"{name}, code"))
    assert not (lines := list(found)), "\n".join(lines)


@pytest.mark.parametrize(
    ("code", "told"),
    [
        pytest.param(
            "import numpy\nfrom q2r2_control.config.cell import Config",
            ["a.py:2: from q2r2_control.config.cell import Config; allowed: from q2r2_control import Config"],
            id="an inner module with a public name",
        ),
        pytest.param(
            "if True:\n    from q2r2_control.config.cell_file import parse_config",
            ["a.py:2: from q2r2_control.config.cell_file import parse_config; allowed: the names in docs/api.md"],
            id="a name that is not public, inside a block",
        ),
        pytest.param(
            "from q2r2_control.plants import base",
            ["a.py:1: from q2r2_control.plants import base; allowed: the names in docs/api.md"],
            id="an inner module of a public package",
        ),
        pytest.param(
            "import q2r2_control.plants.mujoco",
            ["a.py:1: import q2r2_control.plants.mujoco; allowed: the names in docs/api.md"],
            id="an import without from",
        ),
        pytest.param(
            "import numpy\nfrom q2r2_control import Robot\nfrom q2r2_control.plants import MujocoPlant",
            [],
            id="public names",
        ),
    ],
)
def test_an_import_of_an_inner_name_is_reported_with_its_file_its_line_and_what_is_allowed(
    code: str, told: list[str]
) -> None:
    assert list(inner_imports(code, "a.py")) == told


@EACH_PACKAGE
def test_the_page_of_the_api_documents_every_public_name_once(package: str) -> None:
    if package == f"{PACKAGE}.gym":
        pytest.importorskip("gymnasium")
    assert names_on_the_page(package) == sorted(import_module(package).__all__)


@EACH_PACKAGE
def test_every_public_name_exists_and_has_a_docstring(package: str) -> None:
    if (needed := NEEDED.get(package)) is not None and find_spec(needed) is None:
        pytest.skip(f"{needed} is not installed")
    for name in names_on_the_page(package):
        found = getattr(import_module(package), name)
        if inspect.isclass(found) or inspect.isfunction(found):
            # A dataclass without a docstring gets its signature as its docstring.
            assert not (found.__doc__ or f"{name}(").startswith(f"{name}("), f"{package}.{name} has no docstring"


@EACH_PACKAGE
def test_a_type_checker_finds_each_name_in_the_module_that_a_program_imports(package: str) -> None:
    if package == f"{PACKAGE}.gym":
        pytest.importorskip("gymnasium")
    module = import_module(package)
    (block,) = [node for node in ast.parse(inspect.getsource(module)).body if isinstance(node, ast.If)]
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    assert all(alias.asname == alias.name for node in imports for alias in node.names)
    checked = {alias.name: node.module for node in imports for alias in node.names}
    assert checked == {name: resolve_name(f".{inner}", package) for name, inner in module._MODULES.items()}


def test_importing_the_public_packages_imports_nothing_that_their_names_need() -> None:
    # The package gym is left out, because Gymnasium imports numpy.
    packages = ", ".join(package for package in PACKAGES if package != f"{PACKAGE}.gym")
    code = f"import sys, {packages}; print(*(name for name in {HEAVY!r} if name in sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == []


def test_a_public_package_lists_its_names_before_they_are_imported() -> None:
    code = f"from {PACKAGE} import plants; print('MujocoPlant' in dir(plants), hasattr(plants, 'NoPlant'))"
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.stdout.split() == ["True", "False"], result.stderr
