"""Judges of wiping and of a peg in a hole, which get invented states of parts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest

from q2r2_control.demo.contact_judges import PegJudge, WipeJudge
from q2r2_control.demo.part_judges import PartState, Toucher

DT = 0.01
LEFT, TABLE = Toucher.LEFT_FINGER, Toucher.SURROUNDINGS
SETTLES = 0.3  # Time after which the mean of the force has settled [s].


def wiped(strokes: Sequence[tuple[float, float]], touched: int = LEFT | TABLE) -> WipeJudge:
    """Return a wipe judge that has seen ``strokes``. Each has a length [m] and a force [N], and a speed of 0.1 m/s."""
    judge, y = WipeJudge("part"), 0.0
    for length, force in strokes:
        for step in range(round(SETTLES / DT) + round(length / 0.1 / DT)):
            y += 0.1 * DT * (step >= round(SETTLES / DT))
            judge.see(DT, {"part": PartState((0.5, y, 0.2), 0.0, touched, force)})
    return judge


def test_strokes_of_300_mm_with_5_to_15_newtons_count_as_wiped() -> None:
    assert wiped([(0.16, 14.5), (0.16, 6.0)]).faults() == []
    assert wiped([(0.32, 10.0), (0.03, 3.0)]).faults() == []


@pytest.mark.parametrize(
    ("strokes", "touched", "faults"),
    [
        pytest.param([(0.29, 10.0)], LEFT | TABLE, 1, id="too short"),
        pytest.param([(0.4, 10.0), (0.05, 4.0)], LEFT | TABLE, 1, id="too lightly for more than a tenth"),
        pytest.param([(0.4, 10.0), (0.001, 16.0)], LEFT | TABLE, 1, id="too hard for a moment"),
        pytest.param([(0.4, 10.0)], TABLE, 1, id="without a hand"),
        pytest.param([(0.4, 0.0)], LEFT, 1, id="in the air"),
    ],
)
def test_strokes_with_a_wrong_length_force_or_contact_do_not_count_as_wiped(
    strokes: Sequence[tuple[float, float]], touched: int, faults: int
) -> None:
    assert len(wiped(strokes, touched).faults()) == faults


def stands(off: float = 0.0, above: float = 0.0, tilt: float = 0.0, touched: int = Toucher.PART) -> PegJudge:
    judge = PegJudge({"peg": 0.07, "socket": 0.01})
    socket = PartState((0.66, -0.24, 0.205), 0.0, TABLE | Toucher.PART)
    for _ in range(120):
        judge.see(DT, {"peg": PartState((0.66 + off, -0.24, 0.245 + above), tilt, touched), "socket": socket})
    return judge


def test_the_task_succeeds_if_the_peg_stands_at_the_bottom_of_the_hole_for_a_second() -> None:
    assert stands(off=0.0006, above=0.001, tilt=math.radians(1.5)).faults() == []


@pytest.mark.parametrize(
    "judge",
    [
        pytest.param(stands(above=0.03), id="on top"),
        pytest.param(stands(above=0.01), id="stuck halfway"),
        pytest.param(stands(off=0.05), id="beside it"),
        pytest.param(stands(tilt=math.radians(4.0)), id="inclined"),
        pytest.param(stands(touched=Toucher.PART | LEFT), id="still held"),
    ],
)
def test_the_task_fails_if_the_peg_does_not_stand_freely_in_the_hole(judge: PegJudge) -> None:
    assert len(judge.faults()) == 1
    assert judge.measured()["stood_s"] == 0.0
