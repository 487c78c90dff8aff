"""The application for Sunrise. Only its text is tested, because KUKA's libraries are not available here."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import yaml

from q2r2_control.plants.fri.session_state import TORQUE_PERIOD

CHECKOUT = Path(__file__).parents[3]
FILE = CHECKOUT / "robots/kuka/Q2r2Overlay.java"
TEXT = FILE.read_text(encoding="utf-8")


def choices(name: str) -> list[str]:
    """Return the answers that an operator may choose at the smartPAD."""
    found = re.search(rf"{name} = {{(.*?)}};", TEXT)
    assert found is not None
    return re.findall(r'"(.*?)"', found[1])


def test_the_application_has_no_motion_except_a_hold() -> None:
    code = re.sub(r"/\*.*?\*/|//[^\n]*", "", TEXT, flags=re.DOTALL)
    assert len(re.findall(r"\.move(?:Async)?\(", code)) == 1
    assert ".move(positionHold(" in code
    assert not re.search(r"\b(?:ptp|lin|circ|spl|batch|ptpHome|handGuiding)\w*\(", code)


def test_the_applications_ports_equal_the_ports_of_the_shipped_cell_and_its_periods_allow_commands() -> None:
    cell = yaml.safe_load((CHECKOUT / "config/dual_iiwa7_fri.yaml").read_text(encoding="utf-8"))
    assert choices("PORTS") == [str(cell["fri"][arm]["port"]) for arm in ("left", "right")]
    assert all(1 <= int(period) <= 10 for period in choices("POSITION_PERIODS_MS"))
    assert all(1 <= int(period) <= 1e3 * TORQUE_PERIOD for period in choices("TORQUE_PERIODS_MS"))


def test_the_application_is_installed_with_the_package() -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))
    (pattern,) = project["tool"]["setuptools"]["data-files"]["share/q2r2_control/robots/kuka"]
    assert FILE in CHECKOUT.glob(pattern)
