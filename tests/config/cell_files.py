"""Functions for tests of cell files: they change the shipped cell, and return the error message about a file."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.yaml_text import read_yaml, yaml_of
from q2r2_control.errors import ConfigError

SHIPPED = Path(__file__).resolve().parents[2] / "config"
CELL = SHIPPED / "dual_iiwa7.yaml"


def shipped() -> dict[str, Any]:
    """Return the data of the shipped cell of two iiwa 7."""
    data: dict[str, Any] = read_yaml(CELL.read_text(encoding="utf-8"))
    return data


def loaded(tmp_path: Path, text: str | bytes) -> Config:
    """Return the cell that a file with ``text`` describes."""
    file = tmp_path / "cell.yaml"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_config(file)


def fault(tmp_path: Path, text: str | bytes) -> str:
    """Load a faulty cell with ``text``. Return the error message without the file's name and the line's number."""
    with pytest.raises(ConfigError) as caught:
        loaded(tmp_path, text)
    message = str(caught.value)
    found = re.fullmatch(re.escape(str(tmp_path / "cell.yaml")) + r"(, line \d+)?: (.*)", message)
    assert found is not None
    assert len(message) < 1000  # It names all keys of a cell, but only the beginning of a long text.
    return found[2]


def changed(path: str, value: object, cell: Callable[[], dict[str, Any]] = shipped) -> str:
    """Return a cell as YAML with one value replaced or added. Dots separate the keys in ``path``."""
    data: Any = cell()
    *parents, key = path.split(".")
    place = data
    for parent in parents:
        place = place[int(parent)] if isinstance(place, list) else place.setdefault(parent, {})
    place[int(key) if isinstance(place, list) else key] = value
    return yaml_of(data)
