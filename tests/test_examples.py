"""Examples run unchanged: each script in examples/, the code and commands of the README, and code of docs/."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from typer.testing import CliRunner

from q2r2_control.cli.app import app
from tests.support.modules import ROOT

README = (ROOT / "README.md").read_text(encoding="utf-8")
SCRIPTS = sorted((ROOT / "examples").glob("*.py"))
ROS = "external_controller.py"  # tests/ros runs this example.


Done = subprocess.CompletedProcess[Any]
START_PROCESS: Callable[..., Done] = subprocess.run


def run_command(command: list[str], *arguments: Any, **options: Any) -> Done:
    """Replace ``subprocess.run`` for an example.

    The package's command runs in this process. Any other command runs in a new process.
    """
    if command[:3] != [sys.executable, "-m", "q2r2_control"]:
        return START_PROCESS(command, *arguments, **options)
    result = CliRunner().invoke(app, command[3:])
    assert result.exit_code == 0, result.output
    return subprocess.CompletedProcess(command, 0)


@pytest.fixture
def as_main(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return a function that runs code as the module ``__main__`` of this process, and returns what the code prints."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(subprocess, "run", run_command)

    def run(code: str, name: str, *arguments: object) -> str:
        main = ModuleType("__main__")
        main.__file__ = name
        monkeypatch.setitem(sys.modules, "__main__", main)
        monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
        exec(compile(code, name, "exec"), main.__dict__)
        return capsys.readouterr().out

    return run


@pytest.mark.slow
@pytest.mark.parametrize("script", [script for script in SCRIPTS if script.name != ROS], ids=lambda script: script.stem)
def test_an_example_runs_and_prints_its_result(script: Path, tmp_path: Path, as_main: Callable[..., str]) -> None:
    code = script.read_text(encoding="utf-8")
    pictures = [tmp_path / "picture.png"] if "PICTURE" in code else []
    assert as_main(code, str(script), *pictures).strip()
    assert all(picture.stat().st_size > 10_000 for picture in pictures)


def test_the_code_of_the_readme_runs(as_main: Callable[..., str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert as_main(code, "README.md").strip().endswith("True")


@pytest.mark.parametrize(("page", "ends"), [("api.md", "True 0"), ("solvers.md", "")])
def test_the_code_of_a_page_of_docs_runs_from_the_first_to_the_last_line(
    page: str, ends: str, as_main: Callable[..., str]
) -> None:
    parts = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.DOTALL)
    assert parts
    assert as_main("".join(parts), page).strip().endswith(ends)


def test_every_command_that_the_readme_names_exists() -> None:
    commands = set(re.findall(r"q2r2 ([a-z]+(?:-[a-z]+)?)", README))
    assert commands >= {"demo", "run", "check", "headset-check", "bench", "soak"}
    for command in commands:
        assert CliRunner().invoke(app, [command, "--help"]).exit_code == 0, command
