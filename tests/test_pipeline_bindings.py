"""Held controls in the whole loop: the contract at every tick, and the tool follows what they make of the hand."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.pipeline import Pipeline
from q2r2_control.types import Array, HandInputs, HandSample
from tests.support.hands_input import ENGAGED, HandsInput
from tests.support.watch import Watch, cell

SPEED, RADIUS = 0.25, 0.08  # of the left hand's circle [m/s], [m]
HELD_FOR = 0.35  # and let go for as long [s]


def circle(t: float) -> Array:
    angle = SPEED / RADIUS * max(t - ENGAGED - 0.2, 0.0)
    return np.array([0.0, RADIUS * np.sin(angle), RADIUS * (1.0 - np.cos(angle)), 0.0, 0.3 * np.sin(angle), 0.0])


class SqueezingHands(HandsInput):
    """Its left hand circles, turning, and squeezes the grip again and again; the grip alone engages if so bound."""

    def __init__(self, presses: bool) -> None:
        super().__init__(left=circle)
        self._presses = presses

    def _sample(self, hand: str, inputs: HandInputs, now: float) -> HandSample:
        squeezed = float(now > ENGAGED and now % (2.0 * HELD_FOR) < HELD_FOR)
        changed: dict[str, Any] = {"press_middle": squeezed} | ({} if self._presses else {"button_lower": False})
        return super()._sample(hand, replace(inputs, **changed), now)


def run(**bindings: str) -> Watch:
    teleop = TeleopSettings.model_validate({"bindings": bindings})
    config = cell().model_copy(update={"loop_rate_hz": 500.0, "teleop": teleop})
    hands = SqueezingHands(presses=bindings["grip"] != "dead_man")
    loop = Pipeline.from_config(config, input=hands, plant="kinematic")
    watch = Watch(loop)
    loop.run(5.0, realtime=False)
    return watch


@pytest.mark.parametrize("action", ["precision", "rotation_lock", "translation_lock"])
def test_an_arm_follows_without_a_jump_while_a_control_is_squeezed_again_and_again(action: str) -> None:
    ticks = run(grip=action).ticks
    targets = [tick.targets["left"].pose for tick in ticks if tick.targets["left"].pose is not None]
    steps = [float(np.linalg.norm(b.translation - a.translation)) for a, b in pairwise(targets)]
    assert max(steps) < 2.0 * SPEED / 500.0
    errors = [
        float(np.linalg.norm(tick.targets["left"].pose.translation - tick.tools["left"].translation))
        for tick in ticks
        if tick.targets["left"].pose is not None
    ]
    assert max(errors) < 0.015
    assert all(tick.engaged["left"] for tick in ticks if 0.5 < tick.t < 5.0)


def test_with_a_dead_man_the_arm_is_engaged_while_it_is_held_and_at_rest_soon_after() -> None:
    watch = run(lower="none", grip="dead_man")
    assert len(watch.engagements("left")) >= 6
    for tick in watch.ticks:
        since = tick.t % (2.0 * HELD_FOR)
        if 0.6 < tick.t < 5.0 and 0.03 < since < HELD_FOR - 0.01:
            assert tick.engaged["left"]
        if 0.6 < tick.t < 5.0 and since > HELD_FOR + 0.03:
            assert not tick.engaged["left"]
            if since > HELD_FOR + 0.3:
                assert np.abs(tick.reference.v).max() < 0.02
    for index in watch.engagements("left"):
        tick = watch.ticks[index]
        pose = tick.targets["left"].pose
        assert pose is not None
        assert np.linalg.norm(pose.translation - tick.tools["left"].translation) < 1e-6
