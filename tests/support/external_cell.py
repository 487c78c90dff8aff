"""The YAML of the shipped cell in which the block ``external`` or ``robot`` is no longer a comment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from q2r2_control.config.yaml_text import read_yaml

CELL = Path(__file__).resolve().parents[2] / "config" / "dual_iiwa7.yaml"


def external_text() -> str:
    """Return the YAML in which the block ``external`` is active. All other comments stay."""
    text = _uncommented("external", CELL.read_text(encoding="utf-8"))
    assert "controller: builtin " in text
    return text.replace("controller: builtin ", "controller: external ")


def robot_text() -> str:
    """Return the YAML in which the block ``robot`` is active. All other comments stay."""
    return _uncommented("robot", CELL.read_text(encoding="utf-8").replace("robot: null ", "# "))


def _uncommented(key: str, text: str) -> str:
    before, marker, after = text.partition(f"# {key}:\n")
    block, blank, rest = after.partition("\n\n")
    return before + "\n".join(line.removeprefix("# ") for line in (marker + block).splitlines()) + blank + rest


def external() -> dict[str, Any]:
    """Return the data of :func:`external_text`."""
    data: dict[str, Any] = read_yaml(external_text())
    return data
