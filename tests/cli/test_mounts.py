"""``q2r2 mounts``, with which an operator measures the pose of the right arm's base."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.cli.mounts import mount_report
from q2r2_control.config.cell_file import load_config
from q2r2_control.robot.robot import Robot
from tests.cli.command import one_object, q2r2

POINTS = np.array([[0.5, 0.1, 0.3], [0.6, -0.2, 0.3], [0.4, 0.0, 0.5]])


def test_with_the_printed_mount_the_right_tip_is_at_the_points_that_the_left_tip_touched() -> None:
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


def test_postures_in_a_file_give_the_mount_of_arms_without_cabinets(tmp_path: Path) -> None:
    """The right base is not where the cell says. Both arms touch the same points, with tips 20 mm beyond the tools."""
    tip, off = np.array([0.0, 0.0, 0.02]), np.array([0.012, -0.03, 0.004])
    robot = Robot.from_config(load_config("config/dual_ur5.yaml"))
    data = robot.model.createData()
    lines = ["# shoulder to wrist, left and right"]
    for point in ([0.45, 0.0, 0.5], [0.55, 0.1, 0.4], [0.4, -0.1, 0.35], [0.5, 0.05, 0.6]):
        q = robot.home.copy()
        for _ in range(50):  # The joints converge to a posture in which the tips are where the cell expects them.
            for name, wanted in (("left", np.array(point)), ("right", np.array(point) - off)):
                pose, arm = robot.tool_pose(q, name), robot.arms[name]
                frame = arm.frame_id, pin.LOCAL_WORLD_ALIGNED
                jacobian = pin.computeFrameJacobian(robot.model, data, q, *frame)[:, arm.joints]
                way = jacobian[:3] - pin.skew(pose.rotation @ tip) @ jacobian[3:]
                q[arm.joints] += 0.5 * np.linalg.pinv(way) @ (wanted - pose.act(tip))
        lines.append(", ".join(str(value) for arm in robot.arms.values() for value in q[arm.joints]))
    file = tmp_path / "touched.txt"
    file.write_text("\n".join(lines))
    command = ("mounts", "config/dual_ur5.yaml", "--postures", str(file), "--tip", "0", "0", "0.02", "--json")
    report = one_object(q2r2(*command).stdout)
    mount = next(arm.mount for side, arm in load_config("config/dual_ur5.yaml").arms.items() if side == "right")
    assert report["position"] == pytest.approx(list(np.array(mount.position) + off), abs=1e-4)
    assert report["rpy"] == pytest.approx(list(mount.rpy), abs=1e-4)
    assert max(report["off_mm"]) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("0 0 0", "line 1 has 3 numbers; allowed: lines of 12 numbers in radians: left_shoulder_pan_joint"),
        (12 * "0 " + "\n" + 11 * "0 ", "line 2 has 11 numbers; allowed: lines of 12 numbers"),
        ("# joints\na" + 11 * " 0", "line 2: could not convert string to float: 'a'; allowed: lines of 12"),
        (11 * "0 " + "nan", "allowed: lines of 12 numbers"),
        (2 * (12 * "0 " + "\n"), "2 points; allowed: 3 or more"),
        ("", "allowed: lines of 12 numbers"),
        (3 * (12 * "0 " + "\n"), "the points are 0 mm about a line"),
        (2 * (12 * "0 " + "\n") + "45 " + 11 * "0 ", "point 3: left_shoulder_pan_joint = 45; allowed: -"),
    ],
)
def test_postures_that_determine_no_mount_are_refused(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "touched.txt"
    file.write_text(text)
    done = q2r2("mounts", "config/dual_ur5.yaml", "--postures", str(file))
    assert done.exit_code == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1


def test_mounts_prints_one_line_without_the_systems_error_number_if_the_file_of_postures_is_missing() -> None:
    done = q2r2("mounts", "config/dual_ur5.yaml", "--postures", "nope.txt")
    assert done.stderr.startswith("q2r2: --postures nope.txt: No such file or directory; allowed: a file with lines of")


def test_tips_that_did_not_touch_the_same_points_give_no_mount(tmp_path: Path) -> None:
    file = tmp_path / "touched.txt"
    file.write_text(
        "0.0 -1.2 1.5 0.0 0.3 0 0.0 -1.4 1.2 0.0 0.9 0\n"
        "1.0 -0.4 1.0 0.0 0.3 0 0.6 -1.9 1.2 0.0 0.9 0\n"
        "-0.8 -1.6 0.5 0.0 0.3 0 0.3 -0.7 0.4 0.0 0.9 0\n"
    )
    done = q2r2("mounts", "config/dual_ur5.yaml", "--postures", str(file))
    assert done.exit_code == 2
    assert "mm apart; allowed: 5 mm; see to --tip" in done.stderr
    assert "position:" not in done.stdout


def test_mounts_needs_a_file_of_postures_for_arms_without_cabinets() -> None:
    done = q2r2("mounts", "config/dual_ur5.yaml")
    assert done.exit_code == 2
    assert "fri: missing; allowed: each arm's cabinet, as {port: 30200}, or --postures FILE" in done.stderr


def test_the_option_points_together_with_a_file_of_postures_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "touched.txt"
    file.write_text(3 * (12 * "0 " + "\n"))
    done = q2r2("mounts", "config/dual_ur5.yaml", "--postures", str(file), "--points", "3")
    assert done.exit_code == 2
    assert "--points: allowed without --postures, whose file has a line a point" in done.stderr


@pytest.mark.slow
@pytest.mark.usefixtures("cabinets")
def test_arms_that_were_not_moved_between_the_points_determine_no_mount(fri_cell: str) -> None:
    done = q2r2("mounts", fri_cell, typed="\n" * 6)
    assert done.exit_code == 2
    assert "point 3 of 3: guide the right tip there" in done.stderr
    assert "the points are 0 mm about a line" in done.stderr.splitlines()[-1]
