"""Tables print what they are given: rich would take a unit in brackets for its markup."""

from __future__ import annotations

import io

from rich.console import Console

from q2r2_control.cell_check import check_cell
from q2r2_control.config import load_config
from q2r2_control.viewer.tables import arm_table


def printed(table: object) -> str:
    console = Console(file=io.StringIO(), width=120)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_every_figure_of_an_arm_has_its_unit() -> None:
    text = printed(arm_table(check_cell(load_config("config/dual_iiwa7.yaml")).arms[0]))
    for unit in ("min [rad]", "max [rad]", "speed [rad/s]", "torque [Nm]"):
        assert unit in text
