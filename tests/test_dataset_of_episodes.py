"""The lines of the README that lead from episodes to a dataset are run with one episode instead of ten."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]
# These lines install and use the package lerobot, which has its own tests.
_ELSEWHERE = ("make ", ".venv-lerobot/")
_SEEDS = "1 2 3 4 5 6 7 8 9 10"


def test_each_line_of_the_readme_does_what_its_comment_says(tmp_path: Path) -> None:
    section = (ROOT / "README.md").read_text().split("## From ten episodes to a dataset")[1]
    found = re.search(r"```sh\n(.*?)```", section, re.DOTALL)
    assert found is not None
    lines = [line for line in found[1].splitlines() if not line.startswith(_ELSEWHERE)]
    assert len(lines) == 4
    assert _SEEDS in lines[0]
    script = "\n".join(["set -e", *lines]).replace(_SEEDS, "1")
    command = tmp_path / "bin" / "q2r2"
    command.parent.mkdir()
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m q2r2_control "$@"\n')
    command.chmod(0o755)
    (tmp_path / "config").symlink_to(ROOT / "config")
    environment = {**os.environ, "PATH": f"{command.parent}{os.pathsep}{os.environ['PATH']}"}
    shell = ("bash", "-c", script)
    done = subprocess.run(shell, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("grasp succeeded") == 1
    assert done.stdout.splitlines().count("identical") == 1
    assert (tmp_path / "report.html").stat().st_size > 10_000
