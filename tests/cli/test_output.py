"""Tables print what they are given, whole, also in a terminal of 80 columns."""

from __future__ import annotations

import io
from dataclasses import dataclass

import pytest
from rich.console import Console
from rich.table import Table

from q2r2_control.cli.output import figure_table, record_table, short_figure

LINK = "left_arm_left_gripper_left_finger_joint_with_a_long_name_indeed"


def printed(table: Table, width: int = 80) -> str:
    console = Console(file=io.StringIO(), width=width)
    console.print(table)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_figures_names_units_and_notes_are_whole_in_80_columns() -> None:
    columns = ("joint", "min [rad]", "speed [rad/s]", "says")
    row = (f"{LINK}_{LINK}", -12.566, "10.472", "nothing is wrong with this joint as far as is known")
    text = printed(figure_table("one arm [m]", columns, [("a heading [x]",), row], ["[rad] is a unit, not a style"]))
    for expected in ("one arm [m]", "[rad]", "[rad/s]", "a heading [x]", "-12.6", "10.472", "[rad] is a unit, not"):
        assert expected in text
    assert "…" not in text
    first = "".join(line[1:].split(" ")[0] for line in text.splitlines())
    assert f"{LINK}_{LINK}" in first


def test_a_record_is_a_column_with_a_row_for_each_field() -> None:
    @dataclass
    class Run:
        name: str
        delays_ms: tuple[float, ...]
        arrival: float | None

    lines = printed(record_table("runs", [Run("ours", (1.0, 20.0), None), Run("theirs", (2.0,), 300.0)])).splitlines()
    assert any(line.split() == ["delays", "ms", "1.00", "20.0", "2.00"] for line in lines)
    assert any(line.split() == ["arrival", "-", "300"] for line in lines)


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "-"), (0.004, "0.00"), (9.994, "9.99"), (9.996, "10.0"), (99.96, "100"), (-12.34, "-12.3")],
)
def test_figures_have_three_digits_or_so(value: float | None, text: str) -> None:
    assert short_figure(value) == text
