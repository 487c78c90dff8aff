"""An even motion of targets stays even in a loop that ticks at other times than their sender."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.supervision.target_stream import TargetExtrapolator
from q2r2_control.supervision.tick_pacer import TickClock

SENDER, LOOP = 0.005, 0.004  # periods [s]
SPEED, RADIUS = 0.3, 0.1  # [m/s], [m]


def circling(t: float) -> pin.SE3:
    angle = SPEED / RADIUS * t
    where = np.array([0.5 + RADIUS * math.cos(angle), RADIUS * math.sin(angle), 0.4])
    return pin.SE3(pin.exp3(np.array([0.0, 0.0, angle])), where)


def played(pose: Callable[[float], pin.SE3], until: float, *, lines: bool, jitter: float = 4e-4) -> list[pin.SE3]:
    """What the loop follows at each tick, where both tick late by up to ``jitter`` [s] and messages take as long."""
    random, line, clock = np.random.default_rng(0), TargetExtrapolator(), TickClock(LOOP)
    sent = [SENDER * k + random.uniform(0.0, jitter) for k in range(int(until / SENDER))]
    received = [t + 5e-4 + random.uniform(0.0, jitter) for t in sent]
    found, taken = [], 0
    for k in range(1, int(until / LOOP) - 1):
        now = LOOP * k + 1e-3 + random.uniform(0.0, jitter)
        while taken < len(sent) and received[taken] <= now:
            line.put(pose(sent[taken]), sent[taken] + 5e-4 if lines else None)
            taken += 1
        if (target := line.at(clock.at(now))) is not None:
            found.append(target)
    return found


def ripple(targets: list[pin.SE3]) -> float:
    """RMS of the speed about its mean, as a share of it, once it goes on evenly."""
    speeds = np.linalg.norm(np.diff([target.translation for target in targets[20:]], axis=0), axis=1)
    return float(np.std(speeds) / np.mean(speeds))


def test_an_even_motion_leaves_evenly_and_without_lines_it_does_not() -> None:
    assert ripple(played(circling, 3.0, lines=True)) < 0.02
    assert ripple(played(circling, 3.0, lines=False)) > 0.3


def test_the_way_is_the_targets_own() -> None:
    for found in played(circling, 3.0, lines=True)[10:]:
        middle = found.translation - np.array([0.5, 0.0, 0.4])
        assert np.linalg.norm(middle) == pytest.approx(RADIUS, abs=2e-4)
        angle = math.atan2(middle[1], middle[0])
        turned = math.remainder(pin.log3(found.rotation)[2] - angle, math.tau)
        assert abs(turned) < 2e-3


def test_a_step_is_no_motion_that_goes_on() -> None:
    line, low = TargetExtrapolator(), pin.SE3.Identity()
    high = pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.002]))
    for k in range(20):
        due = k * SENDER
        line.put(high if k >= 10 else low, due)
        found = line.at(due + 0.8 * SENDER)
        assert found is not None
        assert found.translation[2] in (0.0, 0.002)


def test_a_motion_goes_on_for_no_longer_than_its_targets_may_be_late() -> None:
    line, velocity = TargetExtrapolator(), np.array([0.3, 0.0, 0.0])
    for k in range(10):
        line.put(pin.SE3(np.eye(3), velocity * k * SENDER), k * SENDER)
    end = line.at(9 * SENDER + 1.0)
    assert end is not None
    assert end.translation[0] == pytest.approx(0.3 * (9 + 2.5) * SENDER)


@pytest.mark.parametrize("stamps", [[0.0] * 10, [5e-6 * k for k in range(10)], [0.1 * k for k in range(10)]])
def test_stamps_that_say_nothing_let_targets_be_taken_as_they_are(stamps: list[float]) -> None:
    line = TargetExtrapolator()
    for k, stamp in enumerate(stamps):
        target = circling(k * SENDER)
        line.put(target, stamp)
        assert line.at(stamp + 0.004) is target


def test_a_new_stream_owes_nothing_to_the_one_before() -> None:
    line = TargetExtrapolator()
    for k in range(5):
        line.put(circling(k * SENDER), k * SENDER)
    line.reset()
    assert line.at(5 * SENDER) is None
    target = circling(1.0)
    line.put(target, 5 * SENDER)
    assert line.at(6 * SENDER) is target
