"""The function install_line returns the command that installs an extra."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from q2r2_control import extras
from q2r2_control.extras import PACKAGES, install_line

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]


@pytest.fixture(autouse=True)
def activated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "prefix", "/venv")
    monkeypatch.setenv("VIRTUAL_ENV", "/venv")


def test_in_a_checkout_the_command_contains_the_folder_so_that_it_works_from_any_other_folder() -> None:
    assert install_line("web") == f"pip install -e '{ROOT}[web]'"
    assert install_line("lerobot") == f"make -C {ROOT} lerobot, which makes {ROOT}/.venv-lerobot of some gigabytes"


def test_outside_a_checkout_the_command_names_the_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(extras, "_CHECKOUT", tmp_path)
    assert install_line("web") == "pip install 'q2r2_control[web]'"
    assert install_line("lerobot") == "pip install 'q2r2_control[lerobot]'"


def test_the_command_starts_with_the_python_of_an_environment_that_is_not_activated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("VIRTUAL_ENV")
    monkeypatch.setattr(sys, "executable", "/venv/bin/python")
    assert install_line("web") == f"/venv/bin/python -m pip install -e '{ROOT}[web]'"


def test_every_extra_in_a_message_exists_in_the_package() -> None:
    named = {
        text.split(quote)[1]
        for file in (ROOT / "q2r2_control").rglob("*.py")
        for text in re.split(r"(?:install_line|require|importing)\(", file.read_text(encoding="utf-8"))[1:]
        if (quote := text[0]) in "'\""
    }
    assert len(named) > 10
    assert named <= set(EXTRAS)


@pytest.mark.parametrize("extra", PACKAGES)
def test_an_extra_has_the_packages_that_the_code_requires(extra: str) -> None:
    listed = [Requirement(entry) for entry in EXTRAS[extra]]
    own = {one.name for one in listed if one.name != "q2r2_control"}
    others = {name for one in listed for other in one.extras for name in PACKAGES[other]}
    assert own <= set(PACKAGES[extra]) <= own | others


def test_the_base_has_no_package_of_an_extra() -> None:
    base = {Requirement(entry).name for entry in PROJECT["dependencies"]}
    assert base.isdisjoint(package for packages in PACKAGES.values() for package in packages)


def test_the_quickstart_lists_every_extra_for_users() -> None:
    page = (ROOT / "docs" / "quickstart.md").read_text(encoding="utf-8")
    table = page.partition("| extra |")[2].partition("\n\n")[0]
    named = re.findall(r"`(\w+)`", "".join(re.findall(r"^\|([^|]*)\|", table, re.MULTILINE)))
    assert set(named) == set(EXTRAS) - {"dev", "docs", "release"}
