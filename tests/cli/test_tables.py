"""Tables print what they are given: rich would take a unit in brackets for its markup."""

from __future__ import annotations

import io
from dataclasses import replace

from rich.console import Console

from q2r2_control.cli.cell_report import ArmCheck, JointCheck, KeptPair, PairsWritten, check_cell
from q2r2_control.cli.summary_table import summary_table
from q2r2_control.cli.tables import arm_table, pair_reach_table, pair_table
from q2r2_control.config.cell import load_config
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.robot.reachability import PairReach


def printed(table: object, width: int = 120) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_every_figure_of_an_arm_has_its_unit() -> None:
    text = printed(arm_table(check_cell(load_config("config/dual_iiwa7.yaml")).arms[0]))
    names, units = (line.replace("┃", " ").split() for line in text.splitlines() if line.startswith("┃"))
    assert names == ["min", "home", "max", "speed", "torque"]
    assert units == ["joint", "[rad]", "[rad]", "[rad]", "[rad/s]", "[Nm]"]


def test_names_of_joints_and_links_are_whole_in_80_columns() -> None:
    """Tiago's are long: in 80 columns the figures are whole too, and what is longer than its column goes on below."""
    side = "left_arm_left_gripper_left_finger_joint"
    joint = JointCheck(f"{side}_1", -12.566, -1.234, 12.566, 10.472, 320.0)
    arm = ArmCheck("left", "example-robot-data:tiago_dual", None, None, "left_tool", (0.0, 0.0, 0.0), (joint,))
    text = printed(arm_table(arm), width=80)
    assert joined(text, 0) == f"{side}_1"
    usual = replace(joint, name="left_arm_left_1_joint")
    assert "│ left_arm_left_1_joint " in printed(arm_table(replace(arm, joints=(usual,))), width=80)
    for figure in ("-12.566", "-1.234", "10.472", "320.000"):
        assert figure in text
    check = check_cell(load_config("config/dual_iiwa7.yaml"))
    pair = KeptPair(f"{side}_link_1_0", f"right_{side}_link_with_a_still_longer_name_0", 0.0416, 0.0075)
    text = printed(pair_table(replace(check, nearest=(pair,))), width=80)
    assert joined(text, 0).replace(" ", "") == f"{pair.name_a}|{pair.name_b}"
    assert "41.6" in text
    assert "7.5" in text
    reach = PairReach(pair.name_a, pair.name_b, 0.123)
    text = printed(pair_reach_table(PairsWritten("a.srdf", 100, 0.05, (reach,), ())), width=80)
    assert joined(text, 0).replace(" ", "") == f"{pair.name_a}|{pair.name_b}"
    assert "123" in text


def joined(text: str, column: int) -> str:
    """All lines of one cell of a table of one row."""
    cells = [line.strip("│").split("│")[column].strip() for line in text.splitlines() if line.startswith("│")]
    return "".join(cells)


def test_a_run_by_torque_tells_what_the_measured_links_and_the_torques_did() -> None:
    summary = Pipeline.from_config(load_config("config/dual_iiwa7.yaml"), mode="torque").run(0.05, realtime=False)
    assert summary.torque is not None
    assert summary.torque.min_measured_distance_mm is not None
    nearest = (
        f"{summary.torque.min_measured_distance_mm:.1f} mm, {' | '.join(summary.torque.measured_closest_pair or ())}"
    )
    text = printed(summary_table(summary))
    assert nearest in text.split("nearest measured pair")[1]
    assert "wall pressed by" in text
    assert "no pair" in text
    assert "off its reference" not in text
    pressed = replace(
        summary.torque,
        pressed_pairs=[("left_a", "right_b")],
        max_wall_force_n=51.6,
        off_reference_s={"left": 1.25, "right": 0.0},
        held_ticks=7,
    )
    text = printed(summary_table(replace(summary, torque=pressed)))
    assert "left_a | right_b: 52 N at most" in text
    assert "7 held without a measurement" in text
    assert "left arm off its reference" in text
    assert "1.25 s beyond the impedance's error clip" in text
    assert "right arm off" not in text
    assert "wall" not in printed(summary_table(replace(summary, torque=None)))
