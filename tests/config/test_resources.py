"""The shipped files are found from every folder, and a missing file raises an error of one line."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError

CHECKOUT = Path(__file__).resolve().parents[2]


def test_shipped_files_are_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_config("config/dual_iiwa7.yaml").name == "dual_iiwa7"
    assert find_resource("robots/iiwa7.urdf") == CHECKOUT / "robots" / "iiwa7.urdf"


def test_a_file_in_the_working_directory_is_preferred_to_a_shipped_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "config").mkdir()
    mine = tmp_path / "config" / "dual_iiwa7.yaml"
    mine.write_text("name: mine\narms: {left: {model: iiwa7, home: [0]}}\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert load_config("config/dual_iiwa7.yaml").name == "mine"


@pytest.mark.parametrize(
    "path",
    ["config", "", "config/triple.yaml", "x\0y", "~nobody_of_this_name/x.yaml"],
    ids=["a folder", "nothing", "a misspelling", "a zero byte", "unknown home"],
)
def test_a_name_that_is_not_a_file_raises_an_error_of_one_line(path: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    assert len(str(caught.value).splitlines()) == 1
    if path == "config/triple.yaml":
        assert "config/dual_iiwa14.yaml, config/dual_iiwa7.yaml" in str(caught.value)


def test_the_error_about_a_folder_instead_of_a_file_says_that_the_path_is_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"{tmp_path}: a folder; allowed: the path of a file"):
        find_resource(tmp_path)


def test_every_file_of_config_and_robots_is_part_of_the_installation() -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = project["tool"]["setuptools"]["data-files"]
    for folder in ("config", "robots"):
        shipped = {file for pattern in patterns[f"share/q2r2_control/{folder}"] for file in CHECKOUT.glob(pattern)}
        assert shipped == {file for file in (CHECKOUT / folder).iterdir() if file.suffix in (".yaml", ".urdf", ".srdf")}


@pytest.mark.slow
def test_shipped_files_installed_beside_the_package_are_found_without_the_checkout(tmp_path: Path) -> None:
    """The files lie as after pip install --target. The test runs in its own process."""
    shutil.copytree(CHECKOUT / "q2r2_control", tmp_path / "q2r2_control", ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("config", "robots"):
        shutil.copytree(CHECKOUT / folder, tmp_path / "share" / "q2r2_control" / folder)
    script = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from q2r2_control.config.cell_file import load_config\n"
        "from q2r2_control.robot.robot import Robot\n"
        "from q2r2_control.config.resources import find_resource\n"
        "Robot.from_config(load_config('config/dual_iiwa7.yaml'))\n"
        "print(find_resource('robots/hand_e.urdf'))\n"
    )
    run = subprocess.run([sys.executable, "-c", script], cwd="/", capture_output=True, text=True, timeout=120)
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.strip() == str(tmp_path / "share" / "q2r2_control" / "robots" / "hand_e.urdf")
