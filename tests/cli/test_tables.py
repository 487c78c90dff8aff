"""Tables print what they are given: rich would take a unit in brackets for its markup."""

from __future__ import annotations

import io
from dataclasses import replace

from rich.console import Console

from q2r2_control.cli.cell_report import check_cell
from q2r2_control.cli.summary_table import summary_table
from q2r2_control.cli.tables import arm_table
from q2r2_control.config import load_config
from q2r2_control.pipeline import Pipeline


def printed(table: object) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_every_figure_of_an_arm_has_its_unit() -> None:
    text = printed(arm_table(check_cell(load_config("config/dual_iiwa7.yaml")).arms[0]))
    for unit in ("min [rad]", "max [rad]", "speed [rad/s]", "torque [Nm]"):
        assert unit in text


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
