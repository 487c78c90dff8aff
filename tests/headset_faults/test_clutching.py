"""Hands that are aligned, put elsewhere and engaged anew, and stances: never a motion that nobody made."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.types import SIDES
from tests.support.headset_in_step import InStepRun, Operator

ANEW = pin.SE3(pin.exp3(np.array([0.0, 0.0, math.radians(120.0)])), np.array([0.4, 0.0, 0.0]))
STILL = 5e-4  # [m]


@pytest.mark.parametrize("samples", [0, 1], ids=["with the second button", "in the next sample"])
@pytest.mark.parametrize("shift", [1.0, 0.1], ids=["far", "by less than the gates"])
@pytest.mark.parametrize("first", ["lower", "upper"])
def test_an_alignment_within_30_ms_moves_no_arm_and_no_gripper_wherever_the_frame_goes(
    first: str, shift: float, samples: int
) -> None:
    frame = pin.SE3.Interpolate(pin.SE3.Identity(), ANEW, shift)

    def script(op: Operator) -> Iterator[float]:
        yield from op.engage()
        yield 0.2
        (op.lower if first == "lower" else op.upper).add("left")
        yield 0.03
        op.lower.add("left")
        op.upper.add("left")
        yield samples * op.period
        op.frame = frame
        yield 0.2
        op.lower.clear()
        op.upper.clear()
        yield 0.2

    run = InStepRun(script)
    assert run.reasons("lost") == []
    assert len(run.reasons("aligning")) == 2
    assert run.states == {"engaged"}
    assert {tick.targets[arm].gripper for tick in run.ticks for arm in SIDES} == {1.0}
    for arm in SIDES:
        assert np.linalg.norm(run.tool(arm) - run.tool(arm)[0], axis=1).max() < STILL


def test_hands_that_resume_from_elsewhere_a_hundred_times_leave_the_arms_where_they_are() -> None:
    def taps(op: Operator) -> Iterator[float]:
        for _ in range(2):
            op.lower |= set(SIDES)
            yield 0.03
            op.lower -= set(SIDES)
            yield 0.03

    def script(op: Operator) -> Iterator[float]:
        op.noise = 1e-9  # enough for no frozen pose
        yield from op.engage()
        yield from op.press(*SIDES)
        for hand, at in op.hands.items():
            op.hands[hand] = pin.SE3(ANEW.rotation @ at.rotation, at.translation + ANEW.translation)
        yield 0.2
        yield from op.press(*SIDES)
        marks.append(op.now)
        for _ in range(100):
            yield from taps(op)

    marks: list[float] = []
    run = InStepRun(script)
    assert run.reasons("lost") == []
    assert [len(run.watch.engagements(arm)) for arm in SIDES] == [102, 102]
    for arm in SIDES:
        places = np.array([tick.tools[arm].translation for tick in run.ticks if tick.t >= marks[0]])
        assert np.linalg.norm(places - places[0], axis=1).max() < 1e-6


def test_an_arm_that_has_sagged_by_2_cm_resumes_from_where_it_is() -> None:
    def script(op: Operator) -> Iterator[float]:
        op.plant.push("left", np.array([0.0, 0.0, -75.0, 0.0, 0.0, 0.0]), 100.0)
        yield 0.8
        sagged.append(op.now)
        op.hands = {hand: ANEW * at for hand, at in op.hands.items()}
        yield 0.5
        yield from op.press(*SIDES)

    sagged: list[float] = []
    run = InStepRun(script, {"position_stiffness": 1500.0})
    assert run.tool("left")[0, 2] - next(t for t in run.ticks if t.t >= sagged[0]).tools["left"].translation[2] > 0.018
    assert run.states == {"engaged"}


@pytest.mark.parametrize(
    ("stance", "arm", "sideways"),
    [("side_by_side", "left", 1.0), ("mirror", "right", 1.0), ("mirror_reflected", "right", -1.0)],
)
def test_a_hand_drives_its_arm_along_the_axes_of_its_stance(stance: str, arm: str, sideways: float) -> None:
    def script(op: Operator) -> Iterator[float]:
        yield 0.1
        yield from op.press("left")
        yield from op.move((0.05, 0.04, 0.03), (0.0, 0.0, 0.3), seconds=0.5)
        yield 0.4

    run = InStepRun(script, stance=stance)
    first, last = run.ticks[0].tools[arm], run.ticks[-1].tools[arm]
    np.testing.assert_allclose(last.translation - first.translation, [0.05, sideways * 0.04, 0.03], atol=1e-3)
    np.testing.assert_allclose(pin.log3(last.rotation @ first.rotation.T), [0.0, 0.0, sideways * 0.3], atol=5e-3)
    other = "left" if arm == "right" else "right"
    assert np.linalg.norm(run.tool(other) - run.tool(other)[0], axis=1).max() < 1e-6
