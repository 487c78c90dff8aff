"""Entry points of installed packages are read once, and again after a package was installed."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

import pytest

from q2r2_control import plugins
from q2r2_control.errors import ConfigError
from q2r2_control.export.formats import format_named
from q2r2_control.plugins import EXPORTS, INPUTS, PLANTS, load_class, names_of
from tests.support.modules import install


def test_packages_are_not_read_again_while_nothing_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    names = names_of(INPUTS)
    assert "scripted" in names

    def unwanted(**group: str) -> None:
        pytest.fail("read again")

    monkeypatch.setattr(plugins, "entry_points", unwanted)
    assert names_of(INPUTS) == names


def test_a_package_that_is_installed_while_the_program_runs_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    os.utime(tmp_path, (0, 0))
    assert "pedal" not in names_of(INPUTS)
    install(tmp_path, "pedals", "", f"[{INPUTS}]\npedal = pedals:Pedal\n")
    assert "pedal" in names_of(INPUTS)


@pytest.mark.parametrize(("group", "name"), [(EXPORTS, "zarr"), (PLANTS, "franka")])
def test_the_error_for_the_name_of_a_plugin_in_this_repository_has_the_line_that_installs_the_plugin(
    group: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugins, "points_of", lambda group: {})
    with pytest.raises(ConfigError, match=f"{name}: it is in a package of its own: .*pip install -e ") as error:
        format_named(name) if group == EXPORTS else load_class(group, name)
    described = tomllib.loads((Path(str(error.value).split()[-1]) / "pyproject.toml").read_text(encoding="utf-8"))
    assert name in described["project"]["entry-points"][group]
