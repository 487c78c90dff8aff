"""``q2r2 fri-check``, which listens to the cabinets of a cell."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from q2r2_control.cli.fri_check import cabinet_report
from q2r2_control.config.yaml_text import read_yaml, yaml_of
from q2r2_control.plants.fri.cabinet import Cabinet, CabinetSettings, StillArm
from tests.cli.command import q2r2
from tests.support.robotiq_gripper import SimulatedGripper

WIDE = (10.0,) * 7


def test_jitter_is_measured_against_the_cabinets_period_even_if_messages_are_missing() -> None:
    cabinet = Cabinet(CabinetSettings(*(WIDE,) * 5, period=0.005), StillArm((0.5,) * 7))
    # The fourth message is 1 ms late, and the fifth message is lost.
    times = [0.0, 0.005, 0.010, 0.016, 0.026]
    sent = [cabinet.send(0.0) for _ in range(6)]
    heard = [(sent[index], time) for index, time in zip((0, 1, 2, 3, 5), times, strict=True)]
    report = cabinet_report("left", heard, lost=1)
    assert report.jitter_ms_max == pytest.approx(1.0)
    assert (report.messages, report.lost, report.period_ms) == (5, 1, 5.0)
    assert report.session == "monitoring wait"
    assert report.joints_deg == pytest.approx([28.65] * 7)


@pytest.mark.slow
@pytest.mark.usefixtures("cabinets")
def test_fri_check_describes_both_cabinets_and_exits_with_1_if_a_cabinet_is_not_in_commanding_active(
    fri_cell: str,
) -> None:
    done = q2r2("fri-check", fri_cell, "--duration", "1", "--json")
    told = json.loads(done.stdout)
    assert [cabinet["arm"] for cabinet in told["cabinets"]] == ["left", "right"]
    for cabinet in told["cabinets"]:
        assert (cabinet["fri_version"], cabinet["period_ms"], cabinet["safety"]) == (2, 10.0, "normal")
        assert cabinet["messages"] > 0
    assert min(told["answers_s"]) > 0.0
    active = all(cabinet["session"] == "commanding active" for cabinet in told["cabinets"])
    assert done.exit_code == (0 if active else 1)


@pytest.mark.slow
@pytest.mark.usefixtures("cabinets")
def test_a_line_says_whether_each_modbus_gripper_answers_and_no_gripper_is_moved(fri_cell: str) -> None:
    cell = read_yaml(Path(fri_cell).read_text(encoding="utf-8"))
    with SimulatedGripper() as simulated:
        for arm, port in (("left", simulated.port), ("right", 1)):
            cell["fri"][arm]["gripper"] = {"modbus": f"127.0.0.1:{port}"}
        Path(fri_cell).write_text(yaml_of(cell), encoding="utf-8")
        done = q2r2("fri-check", fri_cell, "--duration", "1", "--json")
    assert [note for note in json.loads(done.stdout)["notes"] if "gripper" in note] == [
        f"left: gripper 127.0.0.1:{simulated.port}, unit 9: not active until a run begins, position 120 of 255",
        "right: gripper 127.0.0.1:1, unit 9: does not answer",
    ]
    assert simulated.written == []


def test_fri_check_prints_one_line_if_a_cabinet_is_silent(fri_cell: str) -> None:
    done = q2r2("fri-check", fri_cell, "--wait", "0.1")
    assert done.exit_code == 2
    assert "left: no FRI message from cabinet 127.0.0.2 on port" in done.stderr.splitlines()[-1]


def test_fri_check_prints_one_line_for_a_cell_without_cabinets() -> None:
    done = q2r2("fri-check", "config/dual_iiwa7.yaml")
    assert done.exit_code == 2
    assert "fri.left: missing; allowed: the cabinet of each arm" in done.stderr.splitlines()[-1]
