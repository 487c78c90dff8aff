"""A resting hand is known better than its samples; one that moves is followed as without; and nothing jumps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import FilterSettings
from q2r2_control.quaternions import floats_of, rotation_vector, se3_of
from q2r2_control.teleop.filters import PoseFilter
from q2r2_control.teleop.rest import RestingPose
from q2r2_control.types import SIDES, Array, HandSample, Pose
from tests.teleop.hands import PAUSED, Operator, pose

pytestmark = pytest.mark.slow

TICK, PERIOD = 0.004, 1.0 / 75.0  # of the loop and of the samples [s]
NOISE, TURN_NOISE = 2e-4, 5e-4  # of a headset, standard deviation of each axis [m], [rad]


class Filtered:
    """A filter with and without the mean at rest, fed with a hand along x."""

    def __init__(self, noise: float = 0.0) -> None:
        self._random, self._noise = np.random.default_rng(4), noise
        self._filter, self._rest = PoseFilter(FilterSettings()), RestingPose()
        start = self._sample(0.0)
        self._filter.reset(start, 0.0)
        self._rest.begin(start, 0.0)
        self.t = self._due = 0.0
        self.plain: list[Array] = []
        self.drawn: list[Array] = []
        self.turned: list[Array] = []

    def _sample(self, x: float) -> Pose:
        noise = self._random.normal(0.0, 1.0, 6) * self._noise
        return floats_of(pose(x + noise[0], noise[1], noise[2], tuple(noise[3:] * TURN_NOISE / NOISE)))

    def run(self, seconds: float, speed: float = 0.0, x: float = 0.0) -> float:
        """Returns where the hand is at the end [m]."""
        for _ in range(round(seconds / TICK)):
            self.t += TICK
            x += speed * TICK
            if self.t >= self._due:
                self._due += PERIOD
                sample = self._sample(x)
                self._filter.add(sample, self.t, self.t)
                self._rest.add(sample)
            plain = self._filter.at(self.t)
            drawn = self._rest.draw(plain, self.t)
            self.plain.append(np.array(plain[0]))
            self.drawn.append(np.array(drawn[0]))
            self.turned.append(np.array(rotation_vector(drawn[1])))
        return x


def test_noise_of_a_resting_hand_is_a_third_of_what_the_filter_leaves_of_it_or_less() -> None:
    filtered = Filtered(NOISE)
    filtered.run(3.0)
    filtered.run(20.0)
    rested = slice(round(3.0 / TICK), None)
    left = np.std(filtered.plain[rested], axis=0)
    assert (left > 0.25 * NOISE).all()
    assert (np.std(filtered.drawn[rested], axis=0) < left / 3.0).all()
    assert (np.std(filtered.turned[rested], axis=0) < 0.1 * TURN_NOISE).all()


@pytest.mark.parametrize("noise", [0.0, NOISE])
@pytest.mark.parametrize("speed", [0.002, 0.03, 1.0])
def test_a_hand_that_sets_off_is_followed_without_a_jump_and_at_once(speed: float, noise: float) -> None:
    filtered = Filtered(noise)
    filtered.run(2.0)
    moved = filtered.run(1.0, speed)
    filtered.run(3.0, 0.0, moved)
    off = np.linalg.norm(np.subtract(filtered.drawn, filtered.plain), axis=1)
    assert off.max() < max(0.45e-3, 2e-3 * min(speed, 0.6))
    steps = np.linalg.norm(np.diff(filtered.drawn[round(0.5 / TICK) :], axis=0), axis=1) / TICK
    assert steps.max() < 1.05 * speed + 0.025
    # Once it moves, and faster than the noise, it is the filter's alone.
    if speed >= 0.03:
        moving = slice(round(2.3 / TICK), round(2.95 / TICK))
        assert np.array_equal(filtered.drawn[moving], filtered.plain[moving])
    assert np.linalg.norm(filtered.drawn[-1] - np.array([moved, 0.0, 0.0])) < 0.1e-3


class NoisyOperator(Operator):
    """Its headset is noisy; its tools are where their targets are."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._random = np.random.default_rng(7)
        self.alter = self._noisy

    def _noisy(self, received: HandSample) -> HandSample:
        turn = pin.exp3(self._random.normal(0.0, TURN_NOISE, 3))
        rotation = turn @ pin.Quaternion(*received.quaternion[[3, 0, 1, 2]]).toRotationMatrix()
        position = received.position + self._random.normal(0.0, NOISE, 3)
        return replace(received, position=position, quaternion=pin.Quaternion(rotation).coeffs())

    def follow(self, seconds: float) -> None:
        self.run(seconds)
        self.tools |= {arm: target.pose for arm, target in self.targets.items() if target.pose is not None}


def test_a_hundred_pauses_of_a_resting_hand_with_noise_hardly_displace_the_tool() -> None:
    driver = NoisyOperator()
    start = dict(driver.tools)
    after_engaging = []
    for _ in range(100):
        driver.run(0.2)
        before = dict(driver.tools)
        driver.press(*SIDES)
        driver.follow(0.3)
        after_engaging += [np.linalg.norm(driver.tools[arm].translation - before[arm].translation) for arm in SIDES]
        driver.press(*SIDES)
        assert driver.states == PAUSED
    drift = [float(np.linalg.norm(driver.tools[arm].translation - start[arm].translation)) for arm in SIDES]
    turned = [float(np.linalg.norm(pin.log3(driver.tools[arm].rotation @ start[arm].rotation.T))) for arm in SIDES]
    assert max(drift) < 0.5e-3
    assert max(turned) < 1e-3
    assert np.mean(after_engaging) < 0.05e-3


def turning(speed: float, seconds: float, then: float) -> tuple[list[pin.SE3], list[pin.SE3]]:
    """A noisy hand that turns [rad/s] and then rests: what was drawn at each tick, and where the hand really was."""
    random, rest, filtered = np.random.default_rng(6), RestingPose(), PoseFilter(FilterSettings())
    axis = np.array([0.6, 0.0, 0.8])
    drawn, real = [], []
    due = 0.0
    for tick in range(round((seconds + then) / TICK)):
        t = tick * TICK
        hand = pose(0.0, 0.0, 0.0, tuple(axis * speed * min(t, seconds)))
        if t >= due:
            due += PERIOD
            noise = pin.SE3(pin.exp3(random.normal(0.0, TURN_NOISE, 3)), random.normal(0.0, NOISE, 3))
            if tick == 0:
                filtered.reset(floats_of(hand), t)
                rest.begin(floats_of(hand), t)
            filtered.add(floats_of(hand * noise), t, t)
            rest.add(floats_of(hand * noise))
        drawn.append(se3_of(rest.draw(filtered.at(t), t)))
        real.append(hand)
    return drawn, real


def angle(one: pin.SE3, other: pin.SE3) -> float:
    return float(np.linalg.norm(pin.log3(one.rotation.T @ other.rotation)))


@pytest.mark.parametrize("speed", [0.1, 6.0])
def test_a_hand_that_has_turned_however_far_is_known_as_well_as_any_when_it_rests(speed: float) -> None:
    drawn, real = turning(speed, seconds=2.0, then=4.0)
    settled = [angle(*both) for both in zip(drawn[-250:], real[-250:], strict=True)]
    assert max(settled) < TURN_NOISE / 2.0, "a mean of 150 samples; the filter alone leaves more than that"
