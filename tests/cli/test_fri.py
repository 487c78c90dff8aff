"""``q2r2 fri-cabinet``, which stands in for a cell's cabinets."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cli.command import q2r2

CELL = "config/dual_iiwa7_fri.yaml"


def test_without_a_client_the_cabinets_wait() -> None:
    done = q2r2("fri-cabinet", CELL, "--duration", "0.3", "--json")
    assert done.exit_code == 0
    waiting = {"state": "monitoring wait", "missed": 0, "trips": []}
    assert json.loads(done.stdout)["cabinets"] == {"left": waiting, "right": waiting}
    assert "left: monitoring wait" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("config/dual_iiwa7.yaml",), "fri.left: missing; allowed: the cabinet of each arm"),
        ((CELL, "--mode", "velocity"), "--mode velocity: allowed: position, torque"),
        ((CELL, "--duration", "-1"), "--duration"),
    ],
)
def test_a_wrong_option_is_one_line(arguments: tuple[str, ...], told: str) -> None:
    done = q2r2("fri-cabinet", *arguments)
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert told in done.stderr


def test_a_wrong_cabinet_is_named_with_what_is_allowed(tmp_path: Path) -> None:
    text = Path(CELL).read_text(encoding="utf-8")
    for wrong, told in (("address: 127.0.0.1", "address: here"), ("version: null", "version: 3")):
        file = tmp_path / "cell.yaml"
        file.write_text(text.replace(wrong, told), encoding="utf-8")
        done = q2r2("check", str(file))
        assert done.exit_code == 2
        assert "fri.left." in done.stderr


def test_a_demo_on_another_plant_is_refused() -> None:
    done = q2r2("demo", "--plant", "kinematic")
    assert done.exit_code == 2
    assert "--plant 'kinematic': allowed: mujoco, fri" in done.stderr
