"""Checks whether the sign-off beside a cell still belongs to that cell."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config, parse_config
from q2r2_control.errors import ConfigError
from q2r2_control.robot.commissioned import fingerprint, load_commissioned, not_commissioned, sign_off_file, slowed
from tests.support.modules import install

TEXT = Path("config/dual_iiwa7_fri.yaml").read_text(encoding="utf-8")
REAL = TEXT.replace("127.0.0.2", "192.170.10.2")
OTHER_PLANT = """
from q2r2_control.plants.kinematic import KinematicPlant

class Other(KinematicPlant):
    @classmethod
    def drives_real_arms(cls, config):
        return {real}
"""


def cell(old: str = "", new: str = "", text: str = REAL) -> Config:
    assert old in text
    return parse_config(text.replace(old, new, 1), "cell.yaml")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("192.170.10.2", "192.170.10.3"),
        ("port: 30201", "port: 30202"),
        ("[0.0, -0.4, 0.0]", "[0.0, -0.41, 0.0]"),
        ("      frame: tool_frame\n", "      frame: tool_frame\n      mount: {position: [0.0, 0.0, 0.01]}\n"),
        ("velocity_scale: 0.95", "velocity_scale: 0.9"),
        ("A2: 4.3", "A2: 4.2"),
        ("tool_tool: 0.01", "tool_tool: 0.02"),
    ],
)
def test_a_change_of_an_address_mount_tool_or_limit_changes_the_fingerprint_of_a_cell(old: str, new: str) -> None:
    assert fingerprint(cell(old, new)) != fingerprint(cell())


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("size: [0.8, 1.6, 0.2]", "size: [0.8, 1.5, 0.2]"),
        ("velocity_scale: 0.95 ", "position_gain: 5.0\n  velocity_scale: 0.95"),
        ("home: [0.0204", "home: [0.03"),
        ("mass: 0.1", "mass: 0.2"),
    ],
)
def test_a_change_of_obstacles_gains_home_or_simulation_does_not_change_the_fingerprint_of_a_cell(
    old: str, new: str
) -> None:
    assert fingerprint(cell(old, new)) == fingerprint(cell())


def test_cabinets_on_this_computer_need_no_commissioning(tmp_path: Path) -> None:
    assert not_commissioned(cell(text=TEXT), tmp_path / "cell.yaml") is None


def test_joints_of_a_slowed_cell_move_at_a_tenth_of_the_allowed_speed() -> None:
    assert slowed(cell()).control.velocity_scale == pytest.approx(0.1 * cell().control.velocity_scale)


def test_a_sign_off_is_valid_only_for_its_own_cell(tmp_path: Path) -> None:
    file = tmp_path / "my_cell.yaml"
    assert not_commissioned(cell(), file) == "there is no my_cell.commissioned.json"
    sign_off_file(file).write_text(json.dumps({"fingerprint": fingerprint(cell()), "date": "2026-01-02"}))
    assert not_commissioned(cell(), file) is None
    changed = not_commissioned(cell("port: 30201", "port: 30205"), file)
    assert changed == "addresses, mounts, tools or limits were changed since 2026-01-02"


@pytest.mark.parametrize("text", ["", "[]", "{}"])
def test_an_invalid_sign_off_is_reported(tmp_path: Path, text: str) -> None:
    file = tmp_path / "my_cell.yaml"
    sign_off_file(file).write_text(text)
    assert "my_cell.commissioned.json cannot be read" in (not_commissioned(cell(), file) or "")


def write_real_cell(folder: Path, *, signed_off: bool) -> Path:
    file = folder / "my_cell.yaml"
    file.write_text(REAL)
    if signed_off:
        date_and_hash = {"fingerprint": fingerprint(load_config(file)), "date": "2026-01-02"}
        sign_off_file(file).write_text(json.dumps(date_and_hash))
    return file


def test_a_real_cell_that_was_not_commissioned_is_refused_with_the_command_that_commissions_it(tmp_path: Path) -> None:
    file = write_real_cell(tmp_path, signed_off=False)
    why = f"{file}: there is no my_cell.commissioned.json; q2r2 commission {file} commissions it"
    with pytest.raises(ConfigError, match=f"^{re.escape(why)}$"):
        load_commissioned(file)
    assert load_commissioned(file, "mujoco") == load_config(file)  # In a simulation, no real arm moves.


def test_a_commissioned_cell_moves_at_a_tenth_of_its_speed_unless_full_speed_is_requested(tmp_path: Path) -> None:
    file = write_real_cell(tmp_path, signed_off=True)
    assert load_commissioned(file) == slowed(load_config(file))
    assert load_commissioned(file, full_speed=True) == load_config(file)


def test_a_cell_with_simulated_cabinets_is_loaded_with_its_full_speed() -> None:
    assert load_commissioned("config/dual_iiwa7_fri.yaml") == load_config("config/dual_iiwa7_fri.yaml")


@pytest.mark.parametrize("real", [True, False])
def test_a_plant_of_another_package_moves_at_a_tenth_of_the_speed_only_if_its_arms_are_real(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, real: bool
) -> None:
    install(tmp_path, "other_arms", OTHER_PLANT.format(real=real), "[q2r2_control.plants]\nother = other_arms:Other\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "other_arms", raising=False)
    as_given = load_config("config/dual_iiwa7.yaml")
    assert load_commissioned("config/dual_iiwa7.yaml", "other") == (slowed(as_given) if real else as_given)
    assert load_commissioned("config/dual_iiwa7.yaml", "other", full_speed=True) == as_given
