"""What q2r2 check finds out about a cell, and what it writes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from q2r2_control.cli.cell_report import check_cell, write_model_pairs
from q2r2_control.config.cell import load_config
from q2r2_control.config.resources import find_resource
from q2r2_control.errors import ConfigError
from q2r2_control.verification.contact_cells import FINGERS, with_contact
from tests.robot.conftest import one_arm

ARM = one_arm()


def test_model_pairs_are_written_once_and_found_to_be_the_same_from_then_on(tmp_path: Path) -> None:
    file = str(tmp_path / "iiwa7.srdf")
    assert write_model_pairs(ARM, tmp_path, 100, 0.05) == {file: True}
    assert write_model_pairs(ARM, tmp_path, 100, 0.05) == {file: False}


def test_a_file_that_says_something_else_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "iiwa7.srdf").write_text("mine")
    with pytest.raises(ConfigError, match=r"iiwa7\.srdf: exists and says something else; remove it"):
        write_model_pairs(ARM, tmp_path, 100, 0.05)
    assert (tmp_path / "iiwa7.srdf").read_text() == "mine"


def test_a_folder_that_does_not_exist_and_a_clearance_too_small_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nowhere: no such folder"):
        write_model_pairs(ARM, tmp_path / "nowhere", 100, 0.05)
    with pytest.raises(ConfigError, match=r"clearance = 0\.02 m: allowed: above control\.min_distance"):
        write_model_pairs(ARM, tmp_path, 100, 0.02)


def test_where_gravity_alone_is_too_much_the_note_says_so_and_promises_nothing_of_slower_stops(tmp_path: Path) -> None:
    urdf = find_resource("robots/iiwa7.urdf").read_text(encoding="utf-8")
    assert urdf.count('velocity="2.268928" effort="110"') == 1  # of A4
    (tmp_path / "arm.urdf").write_text(urdf.replace('velocity="2.268928" effort="110"', 'velocity="2.2" effort="12"'))
    (note,) = check_cell(one_arm(model=str(tmp_path / "arm.urdf"))).notes
    assert re.search(
        r"^left arm: by gravity alone, at rest, left_A4 is asked for up to \d\.\d\d times its torque limit, at "
        r"(-?\d\.\d\d ){7}rad\. In \d+\.\d % of 5000 random postures \(seed 0\) .*, with a full stop in \d+\.\d %\. "
        r"No acceleration limit changes the former",
        note,
    )


def test_what_may_touch_is_said() -> None:
    cell = with_contact(load_config("config/dual_iiwa7.yaml"), FINGERS)
    report = check_cell(cell)
    notes = [note for note in report.notes if "may touch in torque mode" in note]
    assert len(notes) == len(cell.control.contact_allowed) == len(report.as_json()["contacts"])
    for note, allowed in zip(notes, cell.control.contact_allowed, strict=True):
        assert all(name in note for name in allowed.pair)
        assert f"inside by up to {1e3 * allowed.depth:g} mm" in note
