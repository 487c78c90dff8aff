"""The steps of docs/my_robot.md work as written. After the last step, a robot moves that is in no shipped cell."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.config.yaml_text import read_yaml, yaml_of
from tests.cli.command import q2r2
from tests.config.cell_files import SHIPPED
from tests.pipeline.test_plugins import merged
from tests.support.modules import blocks_of

PAGE = "docs/my_robot.md"


@pytest.mark.slow
def test_the_yaml_and_commands_in_my_robot_md_make_a_cell_from_a_urdf_and_its_arms_follow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    doctor, new_cell, check, run = (shlex.split(block)[1:] for block in blocks_of(PAGE, "sh"))
    assert doctor == ["doctor"]  # test_doctor.py tests the output of this command.
    model = new_cell[new_cell.index("--left") + 1]
    assert not any(model in file.read_text(encoding="utf-8") for file in SHIPPED.glob("*.yaml"))
    written = q2r2(*new_cell)
    assert written.exit_code == 0, written.output
    file = Path("my_cell.yaml")
    assert 15 <= len(file.read_text().splitlines()) <= 40
    cell: Any = read_yaml(file.read_text())
    for block in blocks_of(PAGE, "yaml"):
        cell = merged(cell, read_yaml(block))
    file.write_text(yaml_of(cell))
    checked = q2r2(*check)
    assert checked.exit_code == 0, checked.output
    assert "NOTE" not in checked.stdout
    ran = q2r2(*run)
    assert ran.exit_code == 0, ran.output
    assert "at rest" in ran.stdout
    assert sorted(os.listdir()) == ["my_cell.srdf", "my_cell.yaml"]
