"""The leash between a tool and its target.

The leash is tested alone with a tool that does not move, and in the closed loop with a stretched or blocked arm.
"""

from __future__ import annotations

import copy
import math

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import LeashSettings
from q2r2_control.quaternions import floats_of, se3_of
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.leash import Leash
from q2r2_control.teleop.relative import RelativeMotion
from q2r2_control.types import Array
from tests.pipeline.loops import pipeline
from tests.support.hands_input import HandsInput
from tests.teleop.hands import assert_smooth, engaged, pose

DT = 0.001
TOOL = pose(0.5, 0.2, 0.4, (3.0, 0.2, -0.1))
HAND = pose(0.1, -0.3, 1.1, (0.3, -0.5, 0.8))
MOTIONS = {
    "as it is": RelativeMotion(),
    "reduced": RelativeMotion(scale=0.4, rotation_scale=0.5),
    "in the tool's frame, reduced": RelativeMotion(rotation_frame="tool", scale=0.5, rotation_scale=0.5),
    "reflected": RelativeMotion(stance="mirror_reflected", rotation_scale=1.2),
}


class Tied:
    """A hand whose relative motion moves a target, and a leash between this target and a tool. A tick takes 1 ms."""

    def __init__(self, motion: RelativeMotion, **settings: float | None) -> None:
        self.motion, self.leash = motion, Leash(LeashSettings.model_validate(settings))
        self.hand, self.tool, self.now = HAND, TOOL, 0.0
        self.newest = copy.deepcopy(motion)
        self.newest.anchor(HAND, TOOL)
        motion.anchor(HAND, TOOL)
        self.target = self.tick(HAND)

    def tick(self, hand: pin.SE3, dt: float = DT) -> pin.SE3:
        self.hand, self.now = hand, self.now + dt
        newest, tool = floats_of(self.newest.target(hand)), floats_of(self.tool)
        self.target = se3_of(self.leash.target(self.motion, floats_of(hand), newest, tool, self.now))
        return self.target

    def go(self, twist: Array, ticks: int) -> list[pin.SE3]:
        """Move the hand by ``twist`` (6,) [m, rad] in each tick, and return the targets."""
        return [self.tick(moved(self.hand, twist)) for _ in range(ticks)]

    @property
    def distance(self) -> float:
        return float(np.linalg.norm(self.target.translation - self.tool.translation))

    @property
    def angle(self) -> float:
        return float(np.linalg.norm(pin.log3(self.target.rotation @ self.tool.rotation.T)))


def moved(at: pin.SE3, twist: Array) -> pin.SE3:
    return pin.SE3(pin.exp3(twist[3:]) @ at.rotation, at.translation + twist[:3])


def along(*values: float) -> Array:
    return np.array([*values, *[0.0] * (6 - len(values))])


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_a_target_within_the_leash_equals_the_relative_motion_bit_for_bit(motion: RelativeMotion) -> None:
    random = np.random.default_rng(51)
    tied, bounds = Tied(motion, distance=0.1, angle=0.5), [*[0.02] * 3, *[0.1] * 3]
    hands = [moved(HAND, random.uniform(-1.0, 1.0, 6) * bounds) for _ in range(200)]
    targets = [tied.tick(hand).homogeneous for hand in hands]
    motion.anchor(HAND, TOOL)
    np.testing.assert_array_equal(targets, [motion.target(hand).homogeneous for hand in [HAND, *hands]][1:])
    assert tied.leash.position.slip == tied.leash.rotation.slip == 0.0


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_a_taut_leash_keeps_the_target_at_the_leashs_length_and_the_slip_is_the_missing_distance(
    motion: RelativeMotion,
) -> None:
    tied = Tied(motion, distance=0.1, angle=0.5)
    way, turn = 0.6, 0.9
    for target in tied.go(along(way / 600, 0, 0, 0, 0, turn / 600), 600):
        assert tied.distance <= 0.1 + 1e-12
        assert np.isfinite(target.homogeneous).all()
    motion.anchor(HAND, TOOL)
    free = motion.target(tied.hand)
    whole = np.linalg.norm(free.translation - TOOL.translation)
    angle = np.linalg.norm(pin.log3(free.rotation @ TOOL.rotation.T))
    assert tied.distance == pytest.approx(min(whole, 0.1))
    assert tied.angle == pytest.approx(min(angle, 0.5))
    assert tied.leash.position.slip == pytest.approx(whole - 0.1)
    assert tied.leash.rotation.slip == pytest.approx(max(angle - 0.5, 0.0), abs=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["a quaternion", "the other one of the same rotation"])
@pytest.mark.parametrize("turning", [False, True], ids=["position", "rotation"])
def test_the_leash_changes_a_target_only_if_its_distance_exceeds_the_length_of_the_leash(
    turning: bool, sign: float
) -> None:
    leash, length = Leash(LeashSettings(distance=0.1, angle=0.5)), 0.5 if turning else 0.1
    position, (a, b, c, w) = floats_of(TOOL)
    tool = position, (sign * a, sign * b, sign * c, sign * w)
    out = along(0.03, 0, 0, 0, 0.6, 0.8) if turning else along(0.6, 0, -0.8, 0, 0, 0.2)
    out[3 * turning : 3 * turning + 3] *= length
    for beyond in (-1e-8, -1e-11, 1e-11, 1e-8):
        asked = floats_of(moved(TOOL, out * (1.0 + beyond)))
        held = leash.hold(asked, tool)
        assert (held == asked) == (beyond < 0.0)
        slip = (leash.rotation if turning else leash.position).slip
        assert slip == pytest.approx(sum(length * one for one in (1e-11, 1e-8) if 0.0 < one <= beyond), rel=1e-3)


@pytest.mark.parametrize("settings", [{"distance": None}, {"angle": None}, {"distance": None, "angle": None}], ids=str)
def test_without_a_leash_the_target_may_be_at_any_distance_from_the_tool(settings: dict[str, None]) -> None:
    tied = Tied(RelativeMotion(), **settings)
    tied.go(along(0.001, 0, 0, 0.002, 0, 0), 1000)
    assert tied.distance == pytest.approx(1.0 if "distance" in settings else 0.1)
    assert tied.angle == pytest.approx(2.0 if "angle" in settings else 0.5)


def test_a_target_on_a_taut_leash_moves_smoothly_with_its_tool() -> None:
    tied = Tied(RelativeMotion(), distance=0.1, angle=0.5)
    tied.go(along(0.001), 300)
    before = tied.target
    for _ in range(300):
        tied.tool = moved(tied.tool, along(-0.0005, 0.0001))  # Something pushed the tool back.
        target = tied.tick(tied.hand)
        assert np.linalg.norm(target.translation - before.translation) < 0.0006
        assert tied.distance <= 0.1 + 1e-12
        before = target
    assert tied.leash.position.slip == pytest.approx(0.35, abs=0.01)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
@pytest.mark.parametrize("turning", [False, True], ids=["position", "rotation"])
def test_when_the_hand_comes_back_the_target_starts_at_the_tool_and_follows_the_hand_at_once(
    motion: RelativeMotion, turning: bool
) -> None:
    tied = Tied(motion, distance=0.1, angle=0.5)
    out = along(0, 0, 0, 0, 0, 0.002) if turning else along(0.001)
    tied.go(out, 900)
    farthest, held = tied.hand, tied.target
    tied.go(-0.1 * out, 200)
    # The target is nearly where it would be if the hand's farthest pose and the tool pose were the new anchors. It
    # differs a little, because the first part of the hand's return counts as tremor and has no effect.
    motion.anchor(farthest, TOOL)
    expected = motion.target(tied.hand)
    missing = expected.actInv(tied.target)
    assert np.linalg.norm(missing.translation) < 2.1e-3
    assert np.linalg.norm(pin.log3(missing.rotation)) < 13e-3
    way = held.actInv(tied.target)
    assert np.linalg.norm(pin.log3(way.rotation) if turning else way.translation) > 0.1
    assert (tied.leash.rotation.slip if turning else tied.leash.position.slip) > 0.1


def test_the_noise_of_a_resting_hand_never_puts_the_target_at_the_tool() -> None:
    tied, random = Tied(RelativeMotion(), distance=0.1, angle=0.5), np.random.default_rng(4)
    tied.go(along(0.001), 300)
    start, noise = tied.hand, np.zeros(6)
    per_sample = round(0.005 / DT)
    for tick in range(1100 * per_sample):
        if tick % per_sample == 0:
            noise = random.normal(size=6) * [2e-4, 2e-4, 2e-4, 5e-4, 5e-4, 5e-4]
        tied.tick(moved(start, noise))
        assert tied.distance > 0.098


def test_the_target_is_not_put_at_the_tool_while_the_tool_still_follows() -> None:
    tied = Tied(RelativeMotion(), distance=0.1, angle=0.5)
    tied.go(along(0.001), 300)
    for _ in range(150):
        tied.tool = moved(tied.tool, along(0.0004))  # The tool moves at 0.4 m/s.
        target = tied.go(along(-0.0001), 1)[0]
        assert target.translation[0] - tied.tool.translation[0] > 0.02  # The target was never put at the tool.


def test_the_target_jumps_to_the_tool_only_in_a_tick_so_short_that_the_jumps_velocity_is_ignored() -> None:
    tied = Tied(RelativeMotion(), distance=0.1, angle=0.5)
    tied.go(along(0.001), 300)
    for _ in range(4):
        tied.tick(moved(tied.hand, along(-0.001)), dt=0.012)
        assert tied.distance > 0.095
    tied.tick(moved(tied.hand, along(-0.001)), dt=0.002)
    assert tied.distance < 1e-12


def test_a_new_engagement_begins_at_the_tool_with_a_slack_leash_and_no_slip() -> None:
    driver = engaged()
    driver.commanded = dict(driver.tools)
    start = dict(driver.hands)
    away = lambda t: {hand: moved(at, along(0.3 * t)) for hand, at in start.items()}  # noqa: E731
    assert_smooth(driver.run(1.0, away))
    assert all(target.slip == pytest.approx(0.2, abs=0.03) for target in driver.targets.values())
    driver.press("left", "right")
    assert all(target.pose is None for target in driver.targets.values())
    driver.lower = {"left", "right"}
    history = driver.run(0.2)
    for arm, tool in driver.tools.items():
        first = next(targets[arm] for targets in history if targets[arm].pose is not None)
        assert first.pose is not None
        np.testing.assert_allclose(first.pose.translation, tool.translation, atol=1e-9)
        assert first.slip == first.slip_angle == 0.0


# Motions of a hand in the world frame that the arm can follow only in part [m].
OUT = {
    "stretched out forwards": np.array([1.0, 0.0, 0.0]),
    "blocked by the table": np.array([0.0, 0.0, -0.65]),
    "blocked by the other arm": np.array([0.0, -1.2, 0.0]),
}
HELD, BACK = 6.0, 0.002  # Time at which the hand begins to come back [s], and the distance that it comes back [m].
RATE = 500.0  # Rate of the loop [Hz].


@pytest.mark.slow
@pytest.mark.parametrize("out", OUT.values(), ids=OUT)
def test_a_blocked_arm_rests_and_then_follows_the_returning_hand_at_once_without_a_fast_motion(
    out: Array,
) -> None:
    """Within 2.5 s, the left hand moves away smoothly. Then it trembles in place.

    At the time ``HELD``, it begins to come back by the distance ``BACK``.
    """
    farthest = float(np.linalg.norm(out))

    def hand(t: float) -> Array:
        share = 0.5 - 0.5 * math.cos(math.pi * min(max((t - 0.4) / 2.5, 0.0), 1.0))
        back = min(max((t - HELD) / 0.05, 0.0), 1.0)
        way = farthest * share - BACK * back + 0.2e-3 * math.sin(2.0 * math.pi * 9.0 * t) * (2.9 < t < HELD)
        return np.append(way * out / farthest, np.zeros(3))

    ticks: list[Tick] = []
    loop = pipeline(HandsInput(left=hand))
    loop.listeners.append(ticks.append)
    summary = loop.run(HELD + 0.5, realtime=False)
    places, t = np.array([tick.tools["left"].translation for tick in ticks]), np.array([tick.t for tick in ticks])
    way = places @ out / farthest
    speed = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=1) * RATE
    start, held, soon, later = np.searchsorted(t, np.array([0.4, HELD, HELD + 0.25, HELD + 0.45]) - 1e-9)
    assert way[held] - way[start] < farthest - 0.45  # The tool moved at least 0.45 m less than the hand.
    resting = (t > HELD - 0.5) & (t < HELD)
    acceleration = np.array([np.linalg.norm(tick.reference.a) for tick in ticks])[resting]
    assert np.sqrt(np.mean(acceleration**2)) < 0.2  # For an arm in free motion, this value is 0.39 rad/s^2.
    assert speed[resting].max() < 0.01
    # The hand comes back by ``BACK``, which is 2 mm. At the time ``soon``, an almost straight arm has moved by only a
    # part of ``BACK``. An arm that was pushed aside also comes back to its path, so it may move farther than ``BACK``.
    assert -2.0 * BACK < way[soon] - way[held] < -0.5 * BACK
    assert way[later] - way[held] > -2.0 * BACK
    assert speed[t >= HELD].max() < 0.05  # The hand comes back at 0.04 m/s.
    assert summary.arms["left"].slip_mm_max > 350.0
    assert summary.fallback_ticks == summary.uncertified_ticks == 0
