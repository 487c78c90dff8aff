"""Examples run as they stand: each script in examples/, and the code and commands of the README."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from q2r2_control.cli.app import app
from tests.support.modules import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))
ROS = "external_controller.py"  # tests/ros runs it


def run(*arguments: object) -> str:
    """The output of a script."""
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("script", [script for script in SCRIPTS if script.name != ROS], ids=lambda script: script.stem)
def test_an_example_runs_and_prints_what_came_of_it(script: Path, tmp_path: Path) -> None:
    pictures = [tmp_path / "picture.png"] if "PICTURE" in script.read_text() else []
    assert run(script, *pictures).strip()
    assert all(picture.stat().st_size > 10_000 for picture in pictures)


def test_the_code_of_the_readme_runs() -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert run("-c", code).strip().endswith("True")


def test_every_command_that_the_readme_names_exists() -> None:
    commands = set(re.findall(r"q2r2 ([a-z]+(?:-[a-z]+)?)", README))
    assert commands >= {"demo", "run", "check", "headset-check", "bench", "soak"}
    for command in commands:
        assert CliRunner().invoke(app, [command, "--help"]).exit_code == 0, command
