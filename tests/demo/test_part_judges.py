"""Judges of assembly work, which get invented states of parts."""

from __future__ import annotations

import math
from collections.abc import Iterable

import pytest

from q2r2_control.demo.part_judges import (
    FINGERS,
    HELD_TIME,
    CarryJudge,
    HandoverJudge,
    Judge,
    LiftJudge,
    PartState,
    StackJudge,
    Toucher,
)

DT = 0.1
LEFT, RIGHT, TABLE = Toucher.LEFT_FINGER, Toucher.RIGHT_FINGER, Toucher.SURROUNDINGS

# Duration [s], y and z of the part [m], and the bodies that touch the part.
Phase = tuple[float, float, float, int]


def play(judge: Judge, phases: Iterable[Phase]) -> Judge:
    for duration, y, z, touched in phases:
        for _ in range(round(duration / DT)):
            judge.see(DT, {"part": PartState((0.5, y, z), 0.0, touched)})
    return judge


LIES, GRIPPED = (1.0, 0.0, 0.2, TABLE), (0.5, 0.0, 0.2, TABLE | LEFT)
HELD, BACK = (1.5, 0.0, 0.3, LEFT), (1.0, 0.0, 0.2, TABLE)


def test_lifting_succeeds_if_the_part_is_held_up_for_a_second_and_put_back() -> None:
    judge = play(LiftJudge("part"), [LIES, GRIPPED, HELD, GRIPPED, BACK])
    assert judge.faults() == []
    measured = {"lifted_mm": 100.0, "held_s": 1.5, "put_back_mm": 0.0, "fall_mm": 0.0}
    assert judge.measured() == pytest.approx(measured)


def test_one_second_after_a_part_was_put_back_it_may_be_moved_again() -> None:
    lain = [LIES, GRIPPED, HELD, GRIPPED, BACK, BACK]
    elsewhere = (1.0, 0.3, 0.2, TABLE)
    assert play(LiftJudge("part"), [*lain, HELD, elsewhere]).faults() == []
    assert play(LiftJudge("part"), [LIES, GRIPPED, HELD, (0.5, 0.0, 0.2, TABLE), elsewhere]).faults() != []


@pytest.mark.parametrize(
    ("phases", "name", "figure"),
    [
        ([LIES], "held_s", 0.0),
        ([LIES, GRIPPED, (1.5, 0.0, 0.29, LEFT), GRIPPED, BACK], "held_s", 0.0),  # The part is not high enough.
        ([LIES, GRIPPED, (0.5, 0.0, 0.3, LEFT), GRIPPED, BACK], "held_s", 0.5),  # The part is not up long enough.
        ([LIES, (1.5, 0.0, 0.3, TABLE | LEFT), GRIPPED, BACK], "held_s", 0.0),  # The part stands on something.
        ([LIES, GRIPPED, HELD, (0.1, 0.0, 0.25, Toucher.NOTHING), BACK], "fall_mm", 100.0),
        ([LIES, GRIPPED, HELD, GRIPPED, (1.0, 0.02, 0.2, TABLE)], "put_back_mm", 20.0),
        ([LIES, GRIPPED, HELD], "put_back_mm", 100.0),
    ],
)
def test_lifting_succeeds_only_if_the_part_is_held_up_long_enough_and_then_put_back(
    phases: list[Phase], name: str, figure: float
) -> None:
    judge = play(LiftJudge("part"), phases)
    assert len(judge.faults()) == 1
    assert judge.measured()[name] == pytest.approx(figure)


GIVER, BOTH, TAKER = (1.0, 0.0, 0.4, LEFT), (0.5, 0.0, 0.4, FINGERS), (0.5, 0.0, 0.4, RIGHT)
AWAY = (1.2, -0.12, 0.4, RIGHT)


def test_a_part_in_both_hands_must_not_tilt_by_5_degrees_or_more() -> None:
    level, inclined = (math.radians(angle) for angle in (4.9, 5.1))
    for tilt, faults in ((level, []), (inclined, ["part: inclined by 5.1 deg"])):
        judge = play(CarryJudge("part"), [LIES, (1.5, 0.12, 0.3, FINGERS)])
        judge.see(DT, {"part": PartState((0.5, 0.12, 0.3), tilt, FINGERS)})
        assert play(judge, [GRIPPED, BACK]).faults() == faults


@pytest.mark.parametrize(
    ("away", "held", "touched"),
    [
        pytest.param(0.12, 1.5, FINGERS, id="carried by both"),
        pytest.param(0.08, 0.0, FINGERS, id="not far enough"),
        pytest.param(0.12, 0.0, LEFT, id="by one alone"),
    ],
)
def test_carrying_succeeds_only_if_both_hands_carry_the_part_100_mm_away_and_put_it_back(
    away: float, held: float, touched: int
) -> None:
    judge = play(CarryJudge("part"), [LIES, (0.5, 0.0, 0.2, TABLE | FINGERS), (1.5, away, 0.3, touched), GRIPPED, BACK])
    assert judge.measured()["held_s"] == pytest.approx(held)
    assert (judge.faults() == []) == (held >= HELD_TIME)


def test_a_handover_succeeds_if_both_hands_held_the_part_and_the_taker_carries_it_away() -> None:
    judge = play(HandoverJudge("part", LEFT, RIGHT), [LIES, GIVER, BOTH, TAKER, AWAY])
    assert judge.faults() == []
    assert judge.measured()["carried_mm"] == pytest.approx(120.0)


@pytest.mark.parametrize(
    "phases",
    [
        pytest.param([LIES, GIVER, BOTH, TAKER], id="not carried away"),
        pytest.param([LIES, GIVER, BOTH, (0.5, -0.12, 0.4, RIGHT)], id="not for a second"),
        pytest.param([LIES, GIVER, BOTH, (1.2, -0.12, 0.4, FINGERS)], id="the giver does not let go"),
        pytest.param([LIES, BOTH, AWAY], id="the giver never held it alone"),
        pytest.param([LIES, GIVER, TAKER, AWAY], id="never held by both"),
        pytest.param([LIES, GIVER, BOTH, (1.2, -0.12, 0.2, RIGHT | TABLE)], id="pushed over the table"),
    ],
)
def test_a_handover_fails_if_one_of_its_steps_is_missing(phases: list[Phase]) -> None:
    judge = play(HandoverJudge("part", LEFT, RIGHT), phases)
    assert len(judge.faults()) == 1
    assert judge.measured()["held_by_taker_s"] < 1.0


def test_a_handover_fails_if_the_part_falls_between_the_hands() -> None:
    phases = [LIES, GIVER, BOTH, (0.1, 0.0, 0.39, Toucher.NOTHING), TAKER, AWAY]
    judge = play(HandoverJudge("part", LEFT, RIGHT), phases)
    assert len(judge.faults()) == 1
    assert judge.measured()["fall_mm"] == pytest.approx(10.0)


def stack(offset: float = 0.0, height: float = 0.06, tilt: float = 0.0, touched: int = Toucher.PART) -> Judge:
    judge = StackJudge({"low": 0.06, "high": 0.06})
    for _ in range(12):
        lower = PartState((0.5, 0.0, 0.23), 0.0, Toucher.PART | TABLE)
        judge.see(DT, {"low": lower, "high": PartState((0.5, offset, 0.23 + height), tilt, touched)})
    return judge


def test_stacking_succeeds_if_the_part_rests_on_the_other_part_for_a_second() -> None:
    assert stack(offset=0.002, height=0.0598).faults() == []
    assert stack().measured()["stood_s"] == pytest.approx(1.2)


@pytest.mark.parametrize(
    "judge",
    [
        pytest.param(stack(offset=0.015), id="too far off"),
        pytest.param(stack(height=0.0), id="beside it"),
        pytest.param(stack(height=0.065), id="in the air"),
        pytest.param(stack(tilt=math.radians(5.0)), id="inclined"),
        pytest.param(stack(touched=Toucher.PART | LEFT), id="still held"),
    ],
)
def test_stacking_fails_if_the_part_does_not_stand_freely_on_the_other_part(judge: Judge) -> None:
    assert len(judge.faults()) == 1
    assert judge.measured()["stood_s"] == 0.0
