"""The shipped cell with its commented block ``external`` in force, as its own comment says how."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

CELL = Path(__file__).resolve().parents[2] / "config" / "dual_iiwa7.yaml"


def external_text() -> str:
    """The YAML, with all its other comments."""
    before, marker, after = CELL.read_text(encoding="utf-8").partition("# external:\n")
    block, blank, rest = after.partition("\n\n")
    lines = [line.removeprefix("# ") for line in (marker + block).splitlines()]
    assert "controller: builtin " in before
    return before.replace("controller: builtin ", "controller: external ") + "\n".join(lines) + blank + rest


def external() -> dict[str, Any]:
    """What it says."""
    data: dict[str, Any] = yaml.safe_load(external_text())
    return data
