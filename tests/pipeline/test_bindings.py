"""The hands' controls in the whole loop: the contract holds at every tick, and the arms obey the controls."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array, HandInputs, HandSample
from tests.pipeline.loops import pipeline
from tests.support.hands_input import ENGAGED, HandsInput, Path
from tests.support.processes import Watch, cell, speed

SPEED, RADIUS = 0.25, 0.08  # Speed [m/s] and radius [m] of the left hand's circle.


def circle(t: float) -> Array:
    angle = SPEED / RADIUS * max(t - ENGAGED - 0.2, 0.0)
    return np.array([0.0, RADIUS * np.sin(angle), RADIUS * (1.0 - np.cos(angle)), 0.0, 0.3 * np.sin(angle), 0.0])


class PlayingHands(HandsInput):
    """Hands that engage first. Then the left hand moves in circles and uses controls at given times for 0.1 s each."""

    def __init__(self, *pushed: tuple[float, str], left: Path = circle) -> None:
        super().__init__(left=left)
        self._pushed = pushed

    def _sample(self, hand: str, inputs: HandInputs, now: float) -> HandSample:
        for at, field in self._pushed:
            if hand == "left" and at <= now < at + 0.1:
                pushed: dict[str, Any] = {field: True if field.startswith("button") else 1.0}
                inputs = replace(inputs, **pushed)
        return super()._sample(hand, inputs, now)


def watched(hands: HandsInput, duration: float, plant: str = "kinematic", **bindings: str) -> Watch:
    loop = pipeline(hands, plant, teleop=TeleopSettings.model_validate({"bindings": bindings}))
    watch = Watch(loop)
    loop.run(duration, realtime=False)
    return watch


def played(*pushed: tuple[float, str]) -> list[Tick]:
    """Return the ticks of a run whose hands push controls. The trigger stops the arms, and the grip moves them home."""
    return watched(PlayingHands(*pushed), 6.0, trigger="stop", grip="home").ticks


def farthest_from_home(tick: Tick) -> float:
    return float(np.abs(tick.reference.q - cell_robot().home).max())


@cache
def cell_robot() -> Robot:
    return Robot.from_config(cell())


@pytest.mark.slow
def test_a_press_during_homing_brakes_the_arms_to_rest_before_they_are_home() -> None:
    ticks = played((1.5, "press_middle"), (1.9, "button_lower"))
    assert {event.kind for tick in ticks if tick.t > 1.6 for event in tick.events} == {"homing_interrupted"}
    assert {tick.states["right"] for tick in ticks if 1.52 < tick.t < 1.9} == {"homing"}
    after = [tick for tick in ticks if 2.4 < tick.t < 6.0]
    assert set(after[0].states.values()) == {"paused"}
    assert farthest_from_home(after[-1]) > 0.05
    assert max(map(speed, after)) < 0.02


@pytest.mark.slow
def test_after_a_stop_presses_engage_no_arm_and_undoing_the_stop_moves_no_arm() -> None:
    ticks = played((1.5, "press_index"), (2.0, "button_lower"), (2.3, "press_middle"), (3.0, "press_index"))
    stopped = [tick for tick in ticks if set(tick.states.values()) == {"stopped"}]
    assert (stopped[0].t, stopped[-1].t) == (pytest.approx(1.5, abs=0.02), pytest.approx(3.0, abs=0.02))
    resting = [tick for tick in ticks if 1.9 < tick.t < 6.0]
    assert max(map(speed, resting)) < 0.02
    assert all(tick.targets[arm].pose is None for tick in resting for arm in tick.targets)


@pytest.mark.slow
def test_a_program_can_also_start_homing() -> None:
    loop = pipeline(PlayingHands())
    watch = Watch(loop)
    loop.listeners.append(lambda tick: loop.go_home() if 1.5 <= tick.t < 1.502 else None)
    loop.run(6.0, realtime=False)
    events = [event.kind for tick in watch.ticks for event in tick.events if event.arm == "left"]
    assert events == ["pressed", "home_requested", "homing", "homing_arrived"]
    assert set(watch.ticks[-10].states.values()) == {"paused"}
    assert farthest_from_home(watch.ticks[-1]) < 0.005


def wandering(t: float) -> Array:
    """Return the hand's displacement at ``t`` [s] (6,) [m, rad]: a gentle motion along and about all axes.

    The arm comes near no joint limit and no other body.
    """
    since = max(t - ENGAGED - 0.3, 0.0)
    soft = min(since, 1.0) ** 2 * (3.0 - 2.0 * min(since, 1.0))
    x, y, z, about_x, about_y, about_z = np.sin(np.pi * since * np.array([1.0, 0.7, 0.5, 0.8, 1.0, 0.6]))
    return soft * np.array([0.05 * x - 0.02, 0.04 * y, -0.08 * z * z, 0.08 * about_x, 0.08 * about_y, 0.25 * about_z])


@pytest.mark.slow
@pytest.mark.parametrize("plant", ["kinematic", "mujoco"])
def test_with_the_action_carry_one_hand_moves_and_turns_both_tools_and_their_relative_pose_stays(plant: str) -> None:
    hands = PlayingHands((0.35, "press_middle"), left=wandering)
    ticks = watched(hands, 5.0, plant, grip="carry").ticks
    carried = [tick for tick in ticks if tick.states["right"] == "carried"]
    assert carried[0].t == pytest.approx(0.35, abs=0.02)
    assert carried[-1].t > 4.9
    wanted = carried[0].tools["left"].actInv(carried[0].tools["right"])
    for tick in carried:
        assert not tick.reference.report.binding  # No limit affects the motion.
        relation = tick.tools["left"].actInv(tick.tools["right"])
        assert np.linalg.norm(relation.translation - wanted.translation) < 0.001
        assert np.degrees(np.linalg.norm(pin.log3(relation.rotation.T @ wanted.rotation))) < 0.5
    for arm in ("left", "right"):
        assert np.ptp([tick.tools[arm].translation for tick in carried], axis=0).max() > 0.08
        turns = [pin.log3(tick.tools[arm].rotation @ carried[0].tools[arm].rotation.T) for tick in carried]
        assert np.degrees(max(map(np.linalg.norm, turns))) > 12.0


@pytest.mark.slow
def test_settings_that_a_program_changes_apply_from_the_next_tick_on_without_a_jump() -> None:
    loop = pipeline(PlayingHands())
    watch = Watch(loop)
    half = loop.config.teleop.model_copy(update={"position_scale": 0.5})
    loop.listeners.append(lambda tick: loop.change_teleop(half) if 1.5 <= tick.t < 1.502 else None)
    loop.run(4.0, realtime=False)
    events = [event for tick in watch.ticks for event in tick.events if event.arm == "left"]
    assert [event.kind for event in events] == ["pressed", "settings_requested", "settings_changed"]
    assert events[1].reason.detail["changes"] == {"position_scale": 0.5}
    places = np.array([pose.translation for tick in watch.ticks if (pose := tick.targets["left"].pose) is not None])
    speeds = 500.0 * np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert speeds.max() < 2.0 * SPEED
    assert speeds[-500:].mean() == pytest.approx(0.5 * speeds[250:600].mean(), rel=0.05)
