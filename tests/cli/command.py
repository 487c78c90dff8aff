"""The q2r2 command, run as a user or a script runs it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from q2r2_control.cli.app import app
from q2r2_control.config.resources import find_resource
from tests.support.external_cell import external_text

CELL = "config/dual_iiwa7.yaml"
FAST = ("run", CELL, "--plant", "kinematic", "--fast", "--json", "--headless")


def q2r2(*arguments: str, typed: str | None = None) -> Result:
    return CliRunner().invoke(app, arguments, input=typed)


def one_object(text: str) -> dict[str, Any]:
    """Return the JSON object on the only line of stdout."""
    assert text.count("\n") == 1
    found = json.loads(text, parse_constant=pytest.fail)
    assert isinstance(found, dict)
    return found


def changed_cell(folder: Path, old: str, new: str) -> str:
    """Return a file with the shipped cell, in which one text is replaced."""
    text = find_resource(CELL).read_text(encoding="utf-8")
    assert old in text
    file = folder / "cell.yaml"
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    return str(file)


def external_cell(folder: Path, old: str = "mode: filtered", new: str = "mode: filtered") -> str:
    file = folder / "external.yaml"
    file.write_text(external_text().replace(old, new, 1), encoding="utf-8")
    return str(file)
