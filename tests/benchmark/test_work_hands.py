"""The hands of a work motion: they engage both arms as an operator does, and ask for the motion's poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.benchmark.work_motions import ARMS, WORK_MOTIONS
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import SIDES
from tests.teleop.hands import pose
from work_hands import MOVES, WorkHands

DT = 0.004
TOOLS = {"left": pose(0.5, 0.25, 0.38, (np.pi, 0.0, 0.0)), "right": pose(0.5, -0.25, 0.38, (0.0, np.pi, 0.0))}
# The left tool goes 0.2 m ahead and up, at 0.2 m/s; the right one turns.
SHORT = replace(
    WORK_MOTIONS["stretch"],
    name="short",
    duration=1.0,
    tilt=(0.0, 0.9),
    approach=(np.array([TOOLS[arm].translation for arm in ARMS]),),
    path=lambda t, home: home + 0.2 * t * np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 0.0]]),
)
SETTINGS = {
    "as configured": TeleopSettings(),
    "reflected, scaled, axes of Unity": TeleopSettings(
        stance="mirror_reflected", rotation_frame="tool", position_scale=2.0, axes=("+z", "-x", "+y")
    ),
}


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS.keys())
def test_they_engage_both_arms_and_ask_for_the_motion_s_poses(settings: TeleopSettings) -> None:
    hands, teleop = WorkHands(SHORT, TOOLS, settings), Teleop(settings, SIDES)
    hands.start()
    for t in np.arange(0.0, MOVES + SHORT.ends, DT):
        targets = teleop.update(hands.poll(t), TOOLS, t)
        if t < 0.1:
            assert not any(teleop.engaged.values())
        if t < MOVES:
            continue
        assert all(teleop.engaged.values())
        # The filter lags as long at any speed, once a speed lasts.
        for arm, asked in hands.asked(t - teleop.delay).items():
            found = targets[arm].pose
            assert found is not None
            assert np.linalg.norm(found.translation - asked.translation) < 4e-3
            assert np.linalg.norm(pin.log3(found.rotation @ asked.rotation.T)) < 0.025
    goal = hands.asked(MOVES + SHORT.ends)["left"]
    assert np.linalg.norm(goal.translation - TOOLS["left"].translation) == pytest.approx(0.2)
