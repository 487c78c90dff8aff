"""The rooms of control import each other in one direction only."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import q2r2_control

PACKAGE = Path(q2r2_control.__file__).parent
# Rooms of the package that the modules of a folder may import, beside their own, jit, cholesky, types and errors.
MAY_IMPORT = {
    "config": {"config"},
    "control/geometry": {"robot"},
    "control/tasks": {"config", "control/geometry", "robot"},
    "control/safety": {"control/geometry"},
    "compliance": {"config", "control/geometry", "control/tasks", "robot"},
}
EVERYWHERE = {"control.jit", "control.cholesky", "types", "errors"}


def imported(source: Path) -> set[str]:
    """Modules of the package that a file imports, below ``q2r2_control``."""
    tree = ast.parse(source.read_text(encoding="utf-8"))
    modules = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    return {name.removeprefix("q2r2_control.") for name in modules if name.startswith("q2r2_control.")}


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_a_room_imports_only_what_lies_below_it(room: str) -> None:
    allowed = tuple(f"{below.replace('/', '.')}." for below in MAY_IMPORT[room] | {room})
    for source in sorted((PACKAGE / room).glob("*.py")):
        above = {name for name in imported(source) - EVERYWHERE if not f"{name}.".startswith(allowed)}
        assert not above, f"{source.name} imports {above}"
