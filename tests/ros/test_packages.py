"""The packages under ``ros``: what their docstrings say is in them, and what importing them costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.ros.processes import ROOT

PACKAGE = ROOT / "q2r2_control" / "ros"
FOLDERS = [PACKAGE, *(file.parent for file in sorted(PACKAGE.glob("*/__init__.py")))]


def module(folder: Path) -> str:
    return ".".join(folder.relative_to(ROOT).parts)


@pytest.mark.parametrize("folder", FOLDERS, ids=module)
def test_the_docstring_of_a_package_names_all_its_modules(folder: Path) -> None:
    text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text())) or ""
    inside = [file.stem for file in folder.glob("*.py")] + [file.parent.name for file in folder.glob("*/__init__.py")]
    assert [name for name in inside if name != "__init__" and f"``{name}``" not in text] == []


def test_importing_the_packages_imports_no_rclpy() -> None:
    code = f"import sys, {', '.join(map(module, FOLDERS))}; print('rclpy' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (run.stdout, run.stderr) == ("False\n", "")


def test_the_names_that_subclasses_need_come_from_the_package() -> None:
    pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
    from q2r2_control.ros import BaseArmController, BaseNode, run_node

    assert issubclass(BaseArmController, BaseNode)
    assert callable(run_node)
    with pytest.raises(ImportError):
        from q2r2_control.ros import no_such_name  # noqa: F401
