"""What the hands' controls do in the whole loop: the contract at every tick, and the arms do what was asked for."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array, HandInputs, HandSample
from tests.support.hands_input import ENGAGED, HandsInput, Path
from tests.support.processes import Watch, cell

pytestmark = pytest.mark.slow

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


class PlayingHands(HandsInput):
    """Engages at first; its left hand circles; then the left hand pushes controls at given times, for 0.1 s each."""

    def __init__(self, *pushed: tuple[float, str], left: Path = circle) -> None:
        super().__init__(left=left)
        self._pushed = pushed

    def _sample(self, hand: str, inputs: HandInputs, now: float) -> HandSample:
        for at, field in self._pushed:
            if hand == "left" and at <= now < at + 0.1:
                pushed: dict[str, Any] = {field: True if field.startswith("button") else 1.0}
                inputs = replace(inputs, **pushed)
        return super()._sample(hand, inputs, now)


def run(**bindings: str) -> Watch:
    teleop = TeleopSettings.model_validate({"bindings": bindings})
    return watched(SqueezingHands(presses=bindings["grip"] != "dead_man"), teleop, 5.0)


def watched(hands: HandsInput, teleop: TeleopSettings, duration: float, plant: str = "kinematic") -> Watch:
    config = cell().model_copy(update={"loop_rate_hz": 500.0, "teleop": teleop})
    loop = Pipeline.from_config(config, input=hands, plant=plant)
    watch = Watch(loop)
    loop.run(duration, realtime=False)
    return watch


def played(*pushed: tuple[float, str], duration: float = 6.0) -> Watch:
    """With stop on the trigger and the way home on the grip."""
    bindings = {"bindings": {"trigger": "stop", "grip": "home"}}
    return watched(PlayingHands(*pushed), TeleopSettings.model_validate(bindings), duration)


def farthest_from_home(tick: Tick) -> float:
    return float(np.abs(tick.reference.q - cell_robot().home).max())


@cache
def cell_robot() -> Robot:
    return Robot.from_config(cell())


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


def test_the_way_home_is_gone_within_every_promise_and_ends_paused_at_home() -> None:
    ticks = played((1.5, "press_middle")).ticks
    away = next(tick for tick in ticks if tick.t > 1.5)
    assert farthest_from_home(away) > 0.1
    homing = [tick for tick in ticks if set(tick.states.values()) == {"homing"}]
    assert homing[0].t == pytest.approx(1.5, abs=0.02)
    assert homing[-1].t < 5.0
    last = next(tick for tick in ticks if tick.t > homing[-1].t)
    assert set(last.states.values()) == {"paused"}
    assert {event.kind for event in last.events} == {"homing_arrived"}
    assert farthest_from_home(ticks[-1]) < 0.005


def test_a_press_on_the_way_home_ends_it_where_the_arms_come_to_rest() -> None:
    ticks = played((1.5, "press_middle"), (1.9, "button_lower")).ticks
    assert {event.kind for tick in ticks if tick.t > 1.6 for event in tick.events} == {"homing_interrupted"}
    after = [tick for tick in ticks if 2.4 < tick.t < 6.0]
    assert set(after[0].states.values()) == {"paused"}
    assert farthest_from_home(after[-1]) > 0.05
    assert max(float(np.abs(tick.reference.v).max()) for tick in after) < 0.02


def test_a_stop_brings_both_arms_to_rest_and_only_taking_it_back_and_a_press_move_them() -> None:
    ticks = played((1.5, "press_index"), (2.0, "button_lower"), (2.3, "press_middle"), (3.0, "press_index")).ticks
    stopped = [tick for tick in ticks if set(tick.states.values()) == {"stopped"}]
    assert (stopped[0].t, stopped[-1].t) == (pytest.approx(1.5, abs=0.02), pytest.approx(3.0, abs=0.02))
    resting = [tick for tick in ticks if 1.9 < tick.t < 6.0]
    assert max(float(np.abs(tick.reference.v).max()) for tick in resting) < 0.02
    assert all(tick.targets[arm].pose is None for tick in resting for arm in tick.targets)


def test_a_program_may_send_the_arms_home_too() -> None:
    config = cell().model_copy(update={"loop_rate_hz": 500.0})
    loop = Pipeline.from_config(config, input=PlayingHands(), plant="kinematic")
    watch = Watch(loop)
    loop.listeners.append(lambda tick: loop.go_home() if 1.5 <= tick.t < 1.502 else None)
    loop.run(6.0, realtime=False)
    events = [event.kind for tick in watch.ticks for event in tick.events if event.arm == "left"]
    assert events == ["pressed", "home_requested", "homing", "homing_arrived"]
    assert farthest_from_home(watch.ticks[-1]) < 0.005


def wandering(t: float) -> Array:
    """Begins softly, goes along and turns about all axes, where no limit of a joint and no pair is near."""
    since = max(t - ENGAGED - 0.3, 0.0)
    soft = min(since, 1.0) ** 2 * (3.0 - 2.0 * min(since, 1.0))
    x, y, z, about_x, about_y, about_z = np.sin(np.pi * since * np.array([1.0, 0.7, 0.5, 0.8, 1.0, 0.6]))
    return soft * np.array([0.05 * x - 0.02, 0.04 * y, -0.08 * z * z, 0.08 * about_x, 0.08 * about_y, 0.25 * about_z])


@pytest.mark.parametrize("plant", ["kinematic", "mujoco"])
def test_two_tools_that_carry_keep_their_relation_while_one_hand_moves_and_turns_both(plant: str) -> None:
    teleop = TeleopSettings.model_validate({"bindings": {"grip": "carry"}})
    hands = PlayingHands((0.35, "press_middle"), left=wandering)
    ticks = watched(hands, teleop, 5.0, plant).ticks
    carried = [tick for tick in ticks if tick.states["right"] == "carried"]
    assert carried[0].t == pytest.approx(0.35, abs=0.02)
    assert carried[-1].t > 4.9
    wanted = carried[0].tools["left"].actInv(carried[0].tools["right"])
    for tick in carried:
        assert not tick.reference.report.binding  # free motion
        relation = tick.tools["left"].actInv(tick.tools["right"])
        assert np.linalg.norm(relation.translation - wanted.translation) < 0.001
        assert np.degrees(np.linalg.norm(pin.log3(relation.rotation.T @ wanted.rotation))) < 0.5
    for arm in ("left", "right"):
        assert np.ptp([tick.tools[arm].translation for tick in carried], axis=0).max() > 0.08
        turns = [pin.log3(tick.tools[arm].rotation @ carried[0].tools[arm].rotation.T) for tick in carried]
        assert np.degrees(max(map(np.linalg.norm, turns))) > 12.0


def test_what_a_program_changes_counts_from_the_next_tick_on_without_a_jump() -> None:
    config = cell().model_copy(update={"loop_rate_hz": 500.0})
    loop = Pipeline.from_config(config, input=PlayingHands(), plant="kinematic")
    watch = Watch(loop)
    half = config.teleop.model_copy(update={"position_scale": 0.5})
    loop.listeners.append(lambda tick: loop.change_teleop(half) if 1.5 <= tick.t < 1.502 else None)
    loop.run(4.0, realtime=False)
    events = [event for tick in watch.ticks for event in tick.events if event.arm == "left"]
    assert [event.kind for event in events] == ["pressed", "settings_requested", "settings_changed"]
    assert events[1].reason.detail["changes"] == {"position_scale": 0.5}
    following = [tick for tick in watch.ticks if tick.targets["left"].pose is not None]
    ways = [
        float(np.linalg.norm(after.targets["left"].pose.translation - before.targets["left"].pose.translation))  # type: ignore[union-attr]
        for before, after in pairwise(following)
    ]
    assert max(ways) < 2.0 * SPEED / 500.0
    speeds = [
        500.0 * np.mean([way for way, tick in zip(ways, following, strict=False) if since < tick.t < since + 1.0])
        for since in (0.5, 2.5)
    ]
    assert speeds[1] == pytest.approx(0.5 * speeds[0], rel=0.05)
