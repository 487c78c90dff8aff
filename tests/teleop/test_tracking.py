"""The whole layer on scripted hands: the tool's targets are the hand's path, late by the stated delay."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import SIDES
from tests.teleop.hands import pose

DT = 0.002


def tracking_error(script: ScriptedInput, duration: float) -> tuple[float, float]:
    """RMS distance [mm] and angle [deg] of the left target from the ideal hand's path, over all engaged ticks."""
    teleop = Teleop(TeleopSettings(), SIDES)
    tools = {"left": pose(0.5, 0.4, 0.5, (3.0, 0.1, 0.2)), "right": pose(0.5, -0.4, 0.5)}
    script.start()
    distances, angles = [], []
    start = script.hand_pose("left", 0.0)
    for tick in range(round(duration / DT)):
        now = tick * DT
        target = teleop.update(script.poll(now), tools, now)["left"].pose
        if target is not None:
            hand = script.hand_pose("left", now - teleop.delay)
            ideal = tools["left"].translation + hand.translation - start.translation
            distances.append(np.linalg.norm(target.translation - ideal))
            turn = hand.rotation @ start.rotation.T @ tools["left"].rotation
            angles.append(np.linalg.norm(pin.log3(turn.T @ target.rotation)))
    assert len(distances) * DT > duration - 1.5
    return 1e3 * math.sqrt(np.mean(np.square(distances))), math.degrees(math.sqrt(np.mean(np.square(angles))))


@pytest.mark.parametrize("trajectory", ["circle", "rotate"])
def test_a_clean_hand_is_followed_to_a_millimetre_and_a_third_of_a_degree(trajectory: str) -> None:
    distance, angle = tracking_error(ScriptedInput(trajectory, frequency_hz=0.5), 6.0)
    assert distance < 1.0
    assert angle < 0.33


@pytest.mark.parametrize("trajectory", ["circle", "rotate"])
def test_a_human_hand_is_followed_to_two_millimetres_and_half_a_degree(trajectory: str) -> None:
    distance, angle = tracking_error(ScriptedInput(trajectory, human=True, seed=2), 6.0)
    assert distance < 2.0
    assert angle < 0.5
