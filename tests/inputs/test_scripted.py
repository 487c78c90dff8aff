"""Scripted hands: what the demo and the tracking tests rely on."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.errors import ConfigError
from q2r2_control.inputs.assembly import WORKS
from q2r2_control.inputs.scripted import TRAJECTORIES, ScriptedInput
from q2r2_control.types import SIDES, HandSample, HapticFeedback

EVERY = pytest.mark.parametrize("trajectory", list(TRAJECTORIES))


def play(script: ScriptedInput, duration: float, dt: float = 0.01, start: float = 0.0) -> list[HandSample]:
    script.start()
    return [sample for tick in range(round(duration / dt)) for sample in script.poll(start + tick * dt)]


def of(hand: str, samples: list[HandSample]) -> list[HandSample]:
    return [sample for sample in samples if sample.hand == hand]


def flat(samples: list[HandSample]) -> list[tuple[object, ...]]:
    return [(s.hand, s.pose_stamp, s.inputs, *s.position.tolist(), *s.quaternion.tolist()) for s in samples]


@EVERY
@pytest.mark.parametrize("human", [False, True], ids=["clean", "human"])
def test_the_same_seed_gives_the_same_samples_however_they_are_polled(trajectory: str, human: bool) -> None:
    def script() -> ScriptedInput:
        return ScriptedInput(trajectory, human=human, seed=3)

    often, seldom = play(script(), 6.0, dt=0.001), play(script(), 6.0, dt=0.1)
    assert len(seldom) > 500
    assert flat(often)[: len(seldom)] == flat(seldom)


def test_stamps_are_on_the_callers_clock_and_never_in_its_future() -> None:
    script = ScriptedInput("circle", human=True)
    script.start()
    last = dict.fromkeys(SIDES, -math.inf)
    for tick in range(1000):
        now = 5000.0 + tick * 0.01
        for sample in script.poll(now):
            assert last[sample.hand] < sample.pose_stamp <= now
            assert sample.inputs_stamp == sample.pose_stamp
            last[sample.hand] = sample.pose_stamp


@EVERY
@pytest.mark.parametrize("hand", SIDES)
def test_hands_move_smoothly_calmly_and_within_reach(trajectory: str, hand: str) -> None:
    script = ScriptedInput(trajectory)
    dt = 0.005
    poses = [script.hand_pose(hand, tick * dt) for tick in range(4200)]
    positions = np.array([pose.translation for pose in poses])
    way = positions - positions[0]
    lowest = -0.164 if trajectory in WORKS else 0.0
    assert way[:, 2].min() > lowest - 1e-9
    assert np.abs(way).max() <= 0.25 + 1e-9
    velocity = np.diff(positions, axis=0) / dt
    assert np.linalg.norm(velocity, axis=1).max() < 0.5
    assert np.abs(np.diff(velocity, axis=0) / dt).max() < 1.5
    turns = [pin.log3(b.rotation @ a.rotation.T) / dt for a, b in itertools.pairwise(poses)]
    assert np.abs(turns).max() < 1.5
    assert np.abs(np.diff(turns, axis=0) / dt).max() < 5.0


@EVERY
def test_the_hands_are_still_from_the_first_press_until_the_arm_is_engaged(trajectory: str) -> None:
    script = ScriptedInput(trajectory)
    samples = [s for s in play(script, 2.0) if s.pose_stamp < 1.1]
    assert any(s.inputs.button_lower for s in samples)
    assert not samples[0].inputs.button_lower
    assert not samples[-1].inputs.button_lower
    assert np.ptp([s.position for s in of("left", samples)], axis=0).max() < 1e-12


def test_the_right_hand_mirrors_the_left() -> None:
    script = ScriptedInput("rotate")
    reflection = np.diag([1.0, -1.0, 1.0])
    for t in (0.0, 2.0, 5.0, 9.0, 13.0):
        left = script.hand_pose("left", 0.0).rotation.T @ script.hand_pose("left", t).rotation
        right = script.hand_pose("right", 0.0).rotation.T @ script.hand_pose("right", t).rotation
        np.testing.assert_allclose(reflection @ left @ reflection, right, atol=1e-12)


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
@pytest.mark.parametrize("hand", SIDES)
def test_the_twist_leads_from_each_pose_to_the_next(trajectory: str, hand: str) -> None:
    script = ScriptedInput(trajectory)
    dt = 0.01
    for t in np.arange(0.0, 12.0, 0.05).tolist():
        before, after = script.hand_pose(hand, t), script.hand_pose(hand, t + dt)
        twist = script.hand_twist(hand, t + dt / 2.0)
        np.testing.assert_allclose(before.translation + dt * twist.linear, after.translation, atol=2e-6)
        turned = pin.exp3(dt * twist.angular) @ before.rotation
        np.testing.assert_allclose(turned, after.rotation, atol=2e-5)


def test_nothing_comes_before_start_nor_after_close_and_haptics_are_harmless() -> None:
    script = ScriptedInput("circle")
    assert (script.connected, script.poll(0.0)) == (False, [])
    script.start()
    assert script.connected
    assert script.poll(0.0)
    script.send_haptic(HapticFeedback("left", 0.5, 0.5))
    script.close()
    script.close()
    assert (script.connected, script.poll(1.0)) == (False, [])


@pytest.mark.parametrize("now", [math.nan, math.inf, -math.inf], ids=["nan", "infinite", "minus infinite"])
def test_a_clock_that_is_not_finite_gives_nothing(now: float) -> None:
    script = ScriptedInput("circle")
    script.start()
    script.poll(0.0)
    assert script.poll(now) == []


def test_the_script_waits_while_nobody_polls() -> None:
    script = ScriptedInput("circle", hands=("left",))
    script.start()
    script.poll(0.0)
    late = script.poll(1e9)
    assert 70 < len(late) < 80
    assert late[-1].pose_stamp == pytest.approx(1e9, abs=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"trajectory": "spiral"}, "allowed are circle"),
        ({"trajectory": "circle", "hands": ("middle",)}, "allowed are left, right"),
        ({"trajectory": "circle", "rate_hz": 0.0}, "rate_hz = 0"),
        ({"trajectory": "circle", "frequency_hz": math.nan}, "frequency_hz = nan"),
    ],
    ids=["unknown trajectory", "unknown hand", "no rate", "frequency not a number"],
)
def test_a_wrong_setting_is_refused_in_one_line_that_says_what_is_allowed(
    arguments: dict[str, object], message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        ScriptedInput(**arguments)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
