"""Ticks between samples leave out what hands ask for; that must not change what comes of it, nor when."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.teleop.arm import ArmTeleop
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import HandInputs, HandSample

TOOLS = {arm: pin.SE3(np.eye(3), np.array([0.5, y, 0.4])) for arm, y in (("left", 0.2), ("right", -0.2))}
LEVELS = np.array([0.0, 0.0, 0.0, 0.3, 0.7, 1.0])


def _samples(seed: int) -> Iterator[list[HandSample]]:
    """Of ticks of 1 ms: samples of both hands at about 75 Hz, received late, and controls that change at random."""
    random, due = np.random.default_rng(seed), {"left": 0.0, "right": 0.004}
    inputs = dict.fromkeys(due, HandInputs(button_lower=seed % 2 == 0))  # held from the first sample on
    for tick in range(6000):
        now, found = 1e-3 * tick, []
        for hand in due:
            if now < due[hand]:
                continue
            due[hand] = now + random.uniform(0.010, 0.016)
            if now < 1.5:
                pass  # held for long enough to be told
            elif random.random() < 0.12:
                upper, lower = random.random(2) < 0.4
                stick, trigger, grip = random.choice(LEVELS, 3)
                inputs[hand] = HandInputs(upper, lower, 0.0, stick, trigger, grip)
            elif random.random() < 0.06:
                inputs[hand] = HandInputs()
            stamp = now - random.uniform(0.0, 0.006)
            found.append(
                HandSample(hand, np.array([0.0, 0.0, 0.01 * now]), np.array([0.0, 0, 0, 1]), stamp, inputs[hand], stamp)
            )
        yield found


def _told(settings: TeleopSettings, seed: int) -> list[Any]:
    teleop, told = Teleop(settings, tuple(TOOLS)), []
    for tick, samples in enumerate(_samples(seed)):
        targets = teleop.update(samples, TOOLS, 1e-3 * tick, TOOLS)
        poses = [None if target.pose is None else target.pose.translation.tolist() for target in targets.values()]
        told.append((poses, [target.gripper for target in targets.values()], teleop.take_events()))
    return told


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "bindings",
    [{}, {"lower_hold": "home", "upper_double": "swap_hands"}, {"trigger": "gripper_analog", "upper": "none"}],
    ids=["as shipped", "holds and double taps", "a trigger that moves the gripper"],
)
def test_hands_are_obeyed_at_the_same_ticks_as_if_every_tick_looked(
    bindings: dict[str, str], seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = TeleopSettings.model_validate({"bindings": bindings})
    told = _told(settings, seed)
    assert len([event for *_, events in told for event in events]) > 10
    monkeypatch.setattr(ArmTeleop, "settled", False)
    assert told == _told(settings, seed)
