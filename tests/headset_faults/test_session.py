"""A session without a fault.

Both hands move and pause, the left hand turns in the pause, and both engage again and close the grippers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.types import SIDES
from tests.support.headset_in_step import PERIOD, InStepRun, Operator
from tests.support.processes import changes, speed

pytestmark = pytest.mark.slow

CIRCLE, RADIUS, SWAY = 4.0, 0.1, 0.2  # Period [s] and radius [m] of the hands' circle, and their rotation [rad].
TURN = pin.exp3(np.array([math.radians(120.0), 0.0, 0.0]))  # Rotation of the left hand during the pause.
# The poses of the hands, with the time from which they are sent [s].
shown: list[tuple[float, dict[str, pin.SE3]]] = []


def circle(op: Operator) -> Iterator[float]:
    start = dict(op.hands)
    for step in range(round(CIRCLE / PERIOD) + 1):
        phase = math.pi * (1.0 - math.cos(math.pi * step * PERIOD / CIRCLE))
        way = RADIUS * np.array([0.0, math.sin(phase), 1.0 - math.cos(phase)])
        turn = pin.exp3(np.array([0.0, 0.0, SWAY * math.sin(phase)]))
        op.hands = {hand: pin.SE3(turn @ at.rotation, at.translation + way) for hand, at in start.items()}
        shown.append((op.now, dict(op.hands)))
        yield PERIOD


def session(op: Operator) -> Iterator[float]:
    yield from op.engage()
    yield from circle(op)
    yield from op.press(*SIDES)
    yield 0.5
    start = op.hands["left"]
    for step in range(70):
        op.hands["left"] = pin.SE3(pin.exp3(step / 69 * pin.log3(TURN)) @ start.rotation, start.translation)
        yield PERIOD
    yield from op.press(*SIDES)
    yield from circle(op)
    op.upper |= set(SIDES)
    yield 0.1
    op.upper.clear()
    yield 1.0


@pytest.fixture(scope="module")
def run() -> InStepRun:
    return InStepRun(session)


@pytest.mark.parametrize("arm", SIDES)
def test_presses_engage_and_pause_the_arm_and_the_tool_rests_while_the_hand_turns_in_the_pause(
    run: InStepRun, arm: str
) -> None:
    assert changes(run.summary.events, arm)[:4] == [
        *(("idle", "engaged", "pressed"), ("engaged", "pausing", "pressed")),
        *(("pausing", "paused", "pressed"), ("paused", "engaged", "pressed")),
    ]
    first, resumed = run.watch.engagements(arm)
    for index in (first, resumed):
        before, after = (run.ticks[at].tools[arm] for at in (index, index + 50))
        assert np.linalg.norm(after.translation - before.translation) < 1e-3
        assert np.linalg.norm(pin.log3(before.rotation.T @ after.rotation)) < np.radians(0.5)
    turned = [tick for tick in run.ticks if -1.0 < tick.t - run.ticks[resumed].t < -0.1]
    assert max(map(speed, turned)) < 1e-3
    assert np.ptp([tick.tools[arm].translation for tick in turned], axis=0).max() < 1e-4


@pytest.mark.parametrize("arm", SIDES)
def test_the_tool_follows_the_hand_within_5_mm_and_1_degree_and_the_gripper_closes(run: InStepRun, arm: str) -> None:
    times, travelled, off = np.array([t for t, _ in shown]), [], []
    for start in run.watch.engagements(arm):
        first = int(np.searchsorted(times, run.ticks[start].now))
        anchor, tool = shown[first][1][arm], run.ticks[start].tools[arm]
        for tick in run.ticks[start:]:
            due = tick.now - run.loop.teleop.delay
            if not times[first] <= due < times[first] + CIRCLE:
                continue
            hand, got = shown[int(np.abs(times - due).argmin())][1][arm], tick.tools[arm]
            wanted, turn = hand.translation - anchor.translation, hand.rotation @ anchor.rotation.T
            travelled.append(np.linalg.norm(wanted))
            shift = got.translation - tool.translation - wanted
            off.append((np.linalg.norm(shift), np.linalg.norm(pin.log3(got.rotation @ (turn @ tool.rotation).T))))
    assert max(travelled) > 0.19, "circles of 0.1 m radius"
    shift, angle = np.sqrt(np.mean(np.square(off), axis=0))
    assert shift < 5e-3
    assert np.degrees(angle) < 1.0
    assert run.ticks[run.watch.engagements(arm)[1]].grippers[arm] > 0.95
    assert run.ticks[-1].grippers[arm] < 0.05
    assert run.summary.arms[arm].gripper_changes == 1


def test_the_session_needs_no_fallback_and_ends_at_rest(run: InStepRun) -> None:
    summary = run.summary
    assert summary.fallback_ticks == summary.uncertified_ticks == summary.rejected_targets == 0
    assert summary.at_rest
