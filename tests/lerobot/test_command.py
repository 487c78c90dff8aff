"""``q2r2 export lerobot`` as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("lerobot", reason="make test-lerobot installs it")

from tests.cli.command import q2r2
from tests.export.runs import record_two

ROOT = Path(__file__).resolve().parents[2]


def test_a_dataset_has_the_features_that_the_docs_name(tmp_path: Path) -> None:
    record_two(tmp_path / "recordings")
    out = tmp_path / "out"
    result = q2r2("export", "lerobot", str(tmp_path / "recordings"), "--output", str(out), "--workers", "2")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == f"{out}: 2 of 2 recordings at 30 frames per second\n"
    info = json.loads((out / "meta/info.json").read_text())
    names = [line.split("|")[1] for line in (ROOT / "docs/recording.md").read_text().splitlines() if "| `" in line]
    documented = {name for cell in names for name in cell.replace("`", " ").replace(",", " ").split()}
    assert set(info["features"]) <= documented
    assert info["robot_type"] == "dual_iiwa7"
