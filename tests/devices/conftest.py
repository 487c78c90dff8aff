"""Import the plug-in from its folder, with the entry points of its pyproject.toml, as if it were installed."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from tests.support.modules import ROOT, entry_points_of

PLUGIN = "q2r2_devices"
sys.path.insert(0, str(ROOT / "plugins" / PLUGIN))


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Config]:
    """Return a function that makes the shipped cell with the settings of one input, which is found by its name."""
    (tmp_path / f"{PLUGIN}-1.0.dist-info").mkdir()
    (tmp_path / f"{PLUGIN}-1.0.dist-info/entry_points.txt").write_text(entry_points_of(PLUGIN))
    monkeypatch.syspath_prepend(tmp_path)

    def made(name: str, **settings: Any) -> Config:
        changes = {"input": name, "input_settings": {name: settings}, "plant": "kinematic"}
        return load_config("config/dual_iiwa7.yaml").model_copy(update=changes)

    return made
