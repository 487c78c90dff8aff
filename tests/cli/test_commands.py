"""The table of commands: its lines in the help, and the commands that they name."""

from __future__ import annotations

import inspect
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from q2r2_control.cli.commands import COMMANDS, ListedCommand, load
from tests.cli.command import q2r2

HEAVY = ("numba", "pinocchio", "mujoco", "scipy", "rclpy", "numpy", "matplotlib")
EACH_COMMAND = pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)


def first_sentence(text: str) -> str:
    words = inspect.cleandoc(text).partition("\n\n")[0].split()
    return " ".join(words[: next((i for i, word in enumerate(words, 1) if word.endswith(".")), len(words))])


@pytest.mark.parametrize("arguments", [("--help",), (), ("rum",)], ids=["help", "no command", "a wrong command"])
def test_the_help_imports_no_library_that_only_commands_need(arguments: tuple[str, ...]) -> None:
    code = (
        f"import atexit, sys; sys.argv = ['q2r2', *{arguments!r}]\n"
        f"atexit.register(lambda: print('imported:', *(name for name in {HEAVY!r} if name in sys.modules)))\n"
        "from q2r2_control.__main__ import main; main()"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == (0 if arguments == ("--help",) else 2), result.stderr
    assert result.stdout.splitlines()[-1] == "imported:"


@EACH_COMMAND
def test_the_help_lists_every_command_with_the_first_sentence_of_its_function(command: ListedCommand) -> None:
    assert f"\n  {command.name} " in q2r2("--help").stdout
    assert command.about == first_sentence(load(command).help)


@EACH_COMMAND
def test_the_example_of_a_command_is_in_its_help_and_its_options_exist(command: ListedCommand) -> None:
    loaded = load(command)
    if isinstance(loaded, typer.core.TyperGroup):
        assert all(
            f"Example: q2r2 {command.name} {name}" in (one.epilog or "") for name, one in loaded.commands.items()
        )
        return
    assert f"Example: {command.example}\n" in q2r2(command.name, "--help").stdout
    program, name, *arguments = shlex.split(command.example)
    assert (program, name) == ("q2r2", command.name)
    loaded.make_context(name, arguments)  # An unknown option would raise an error here.


def test_the_help_has_every_command_once_under_the_heading_of_its_group() -> None:
    printed = q2r2("--help").stdout
    for command in COMMANDS:
        (section,) = [part for part in printed.split("\n\n") if part.startswith(f"{command.group}:\n")]
        assert len(re.findall(rf"^  {command.name}  ", section, re.MULTILINE)) == 1


def test_a_package_adds_a_command_which_is_listed_in_the_help_and_can_fail_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "my_command.py").write_text(
        "from q2r2_control import ConfigError\n\n"
        "def warm(degrees: float = 20.0) -> None:\n"
        '    """Tell how warm it is."""\n'
        "    if degrees > 100.0:\n"
        '        raise ConfigError("--degrees: allowed: 100 or less")\n'
        '    print(f"{degrees:g} degrees")\n'
    )
    about = tmp_path / "my_package-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\nVersion: 1.0\n")
    points = "[q2r2_control.commands]\nwarm = my_command:warm\ngone = my_command:gone\ncheck = my_command:warm\n"
    (about / "entry_points.txt").write_text(points)

    def called(*arguments: str) -> tuple[int, str, str]:
        path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
        command = [sys.executable, "-m", "q2r2_control", *arguments]
        result = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": path})
        return result.returncode, result.stdout, result.stderr

    assert "\nOther packages:\n  gone  A command of the package my_package." in called("--help")[1]
    assert called("warm", "--degrees", "30") == (0, "30 degrees\n", "")
    assert called("warm", "--degrees", "300") == (2, "", "q2r2: --degrees: allowed: 100 or less\n")
    code, _, said = called("gone")
    assert (code, said.count("\n")) == (2, 1)
    assert said.startswith("q2r2: q2r2_control.commands: gone = my_command:gone: module 'my_command' has no attribute")
    assert "Validate a cell" in called("check", "--help")[1]
