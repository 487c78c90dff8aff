"""Targets are moved ahead along their motion by the delay of the plant."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.pipeline.target_lead import TargetLead

DELAY, DT = 0.016, 0.002


def turned(angle: float) -> np.ndarray:
    return pin.exp3(np.array([0.0, 0.0, angle]))


def followed(lead: TargetLead, position: float, angle: float = 0.0) -> pin.SE3:
    pose = pin.SE3(turned(angle), np.array([position, 0.2, 0.3]))
    led = lead.ahead({"left": pose, "right": None}, DT, DELAY)
    assert led["right"] is None
    assert led["left"] is not None
    return led["left"]


def test_the_target_of_a_steady_motion_is_moved_ahead_by_the_delay() -> None:
    lead = TargetLead()
    for k in range(100):
        led = followed(lead, 0.3 * k * DT, 1.5 * k * DT)
    np.testing.assert_allclose(led.translation, [0.3 * (99 * DT + DELAY), 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(led.rotation, turned(1.5 * (99 * DT + DELAY)), atol=1e-6)


def test_the_first_target_and_a_resting_target_are_unchanged() -> None:
    lead = TargetLead()
    assert followed(lead, 0.1).translation[0] == 0.1
    for k in range(50):
        followed(lead, 0.3 * k * DT)
    for _ in range(100):
        led = followed(lead, 0.4)
    assert led.translation[0] == 0.4


def test_the_target_of_a_motion_that_stops_suddenly_overshoots_for_only_a_short_time() -> None:
    lead, end = TargetLead(), 0.3 * 99 * DT
    for k in range(100):
        followed(lead, 0.3 * k * DT)
    over = [followed(lead, end).translation[0] - end for _ in range(30)]
    assert max(over) <= 0.3 * DELAY
    assert over[15] < 0.1 * over[0]


def test_a_target_that_jumps_is_not_moved_ahead() -> None:
    lead = TargetLead()
    followed(lead, 0.0)
    assert followed(lead, 0.1).translation[0] == 0.1


def test_the_first_target_after_a_pause_is_not_moved_ahead_by_the_motion_before_the_pause() -> None:
    lead = TargetLead()
    for k in range(50):
        followed(lead, 0.3 * k * DT)
    lead.ahead({"left": None, "right": None}, DT, DELAY)
    assert followed(lead, 0.5).translation[0] == pytest.approx(0.5, abs=1e-12)
