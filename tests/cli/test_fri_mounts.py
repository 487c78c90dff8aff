"""``q2r2 fri-mounts``, by which an operator measures where the right arm's base is."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.cli.fri_mounts import mount_report
from q2r2_control.config.cell import load_config
from tests.cli.command import q2r2

POINTS = np.array([[0.5, 0.1, 0.3], [0.6, -0.2, 0.3], [0.4, 0.0, 0.5]])


def test_the_mount_that_is_printed_puts_the_right_tip_where_the_left_one_was() -> None:
    cell = load_config("config/dual_iiwa7_fri.yaml")
    mount = next(arm.mount for side, arm in cell.arms.items() if side == "right")
    assumed = pin.SE3(pin.rpy.rpyToMatrix(*mount.rpy), np.array(mount.position))
    off = np.array([0.01, -0.02, 0.005])
    true = pin.SE3(pin.rpy.rpyToMatrix(0.02, -0.01, 1.5), assumed.translation + off)
    touched = np.array([assumed.act(true.actInv(point)) for point in POINTS])
    report = mount_report(cell, POINTS, touched)
    assert report.position == pytest.approx(true.translation.tolist(), abs=1e-5)
    assert report.rpy == pytest.approx([0.02, -0.01, 1.5], abs=1e-5)
    assert report.moved_mm == pytest.approx(1e3 * np.linalg.norm(off), abs=0.02)
    assert max(report.off_mm) < 0.01


@pytest.mark.usefixtures("cabinets")
def test_arms_that_were_not_moved_between_the_points_tell_nothing(fri_cell: str) -> None:
    done = q2r2("fri-mounts", fri_cell, typed="\n" * 6)
    assert done.exit_code == 2
    assert "point 3 of 3: guide the right tip there" in done.stderr
    assert "the points are 0 mm about a line" in done.stderr.splitlines()[-1]
