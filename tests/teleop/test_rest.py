"""The pose of a resting hand is the mean of its samples, which is more exact than each of them.

For a moving hand the mean has no effect. The filtered pose never jumps between the two cases.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import FilterSettings
from q2r2_control.quaternions import floats_of, se3_of
from q2r2_control.teleop.filters import PoseFilter, RestingPose
from q2r2_control.types import SIDES, HandSample, Pose
from tests.teleop.hands import PAUSED, Operator, pose

TICK, PERIOD = 0.004, 1.0 / 75.0  # Periods of the loop and of the samples [s].
NOISE, TURN_NOISE = 2e-4, 5e-4  # Standard deviation of a headset's noise along [m] and about [rad] each axis.
AXIS = np.array([0.6, 0.0, 0.8])  # Axis about which the hand turns.


class Filtered:
    """The filtered poses of a hand that moves along x and turns.

    ``plain`` contains the poses of the filter alone. ``drawn`` contains poses that are moved towards the mean of the
    samples while the hand rests.
    """

    def __init__(self, noise: float = NOISE) -> None:
        self._random, self._noise = np.random.default_rng(4), noise / NOISE
        self._filter, self._rest = PoseFilter(FilterSettings()), RestingPose()
        self.t = self._due = self.x = self.angle = 0.0
        start = self._sample()
        self._filter.reset(start, 0.0)
        self._rest.begin(start, 0.0)
        self.plain: list[Pose] = []
        self.drawn: list[Pose] = []

    @property
    def hand(self) -> pin.SE3:
        return pose(self.x, turn=tuple(self.angle * AXIS))

    def _sample(self) -> Pose:
        noise = self._random.normal(0.0, self._noise, 6) * [*[NOISE] * 3, *[TURN_NOISE] * 3]
        return floats_of(self.hand * pin.SE3(pin.exp3(noise[3:]), noise[:3]))

    def run(self, seconds: float, speed: float = 0.0, turning: float = 0.0) -> None:
        """Move the hand with constant ``speed`` [m/s] and angular speed ``turning`` [rad/s]."""
        for _ in range(round(seconds / TICK)):
            self.t += TICK
            self.x += speed * TICK
            self.angle += turning * TICK
            if self.t >= self._due:
                self._due += PERIOD
                sample = self._sample()
                self._filter.add(sample, self.t, self.t)
                self._rest.add(sample)
            self.plain.append(self._filter.at(self.t))
            self.drawn.append(self._rest.draw(self.plain[-1], self.t))


def places(poses: list[Pose]) -> np.ndarray:
    return np.array([position for position, _ in poses])


def angle(one: pin.SE3, other: pin.SE3) -> float:
    return float(np.linalg.norm(pin.log3(one.rotation.T @ other.rotation)))


def test_the_mean_reduces_the_noise_of_a_resting_hand_to_less_than_a_third() -> None:
    filtered = Filtered()
    filtered.run(23.0)
    rested = slice(round(3.0 / TICK), None)
    left = np.std(places(filtered.plain[rested]), axis=0)
    assert (left > 0.25 * NOISE).all()
    assert (np.std(places(filtered.drawn[rested]), axis=0) < left / 3.0).all()
    turned = [pin.log3(se3_of(one).rotation) for one in filtered.drawn[rested]]
    assert (np.std(turned, axis=0) < 0.1 * TURN_NOISE).all()


@pytest.mark.parametrize("noise", [0.0, NOISE])
@pytest.mark.parametrize("speed", [0.002, 0.03, 1.0])
def test_a_hand_that_starts_to_move_is_followed_at_once_without_a_jump(speed: float, noise: float) -> None:
    filtered = Filtered(noise)
    filtered.run(2.0)
    filtered.run(1.0, speed)
    filtered.run(3.0)
    drawn, plain = places(filtered.drawn), places(filtered.plain)
    assert np.linalg.norm(drawn - plain, axis=1).max() < max(0.45e-3, 2e-3 * speed)
    steps = np.linalg.norm(np.diff(drawn[round(0.5 / TICK) :], axis=0), axis=1) / TICK
    assert steps.max() < 1.2 * speed + 0.025
    # If the hand moves clearly faster than the noise, the mean has no effect.
    if speed >= 0.03:
        moving = slice(round(2.3 / TICK), round(2.95 / TICK))
        assert np.array_equal(drawn[moving], plain[moving])
    assert np.linalg.norm(drawn[-1] - filtered.hand.translation) < 0.1e-3


@dataclass
class NoisyOperator(Operator):
    """An operator with a noisy headset. The tools are at their targets after each :meth:`follow`."""

    noise: float = NOISE

    def __post_init__(self) -> None:
        super().__post_init__()
        self._random = np.random.default_rng(7)
        self.alter = self._noisy

    def _noisy(self, received: HandSample) -> HandSample:
        turn = pin.exp3(self._random.normal(0.0, TURN_NOISE, 3))
        rotation = turn @ pin.Quaternion(*received.quaternion[[3, 0, 1, 2]]).toRotationMatrix()
        position = received.position + self._random.normal(0.0, self.noise, 3)
        return replace(received, position=position, quaternion=pin.Quaternion(rotation).coeffs())

    def follow(self, seconds: float) -> None:
        self.run(seconds)
        self.tools |= {arm: target.pose for arm, target in self.targets.items() if target.pose is not None}


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "within"), [(NOISE, 0.3e-3), (3.0 * NOISE, 0.6e-3), (5.0 * NOISE, 1.2e-3)])
def test_forty_pauses_with_a_noisy_resting_hand_hardly_displace_the_tool(noise: float, within: float) -> None:
    driver = NoisyOperator(noise=noise)
    start = dict(driver.tools)
    after_engaging = []
    for _ in range(40):
        driver.run(0.2)
        before = dict(driver.tools)
        driver.press(*SIDES)
        driver.follow(0.3)
        after_engaging += [np.linalg.norm(driver.tools[arm].translation - before[arm].translation) for arm in SIDES]
        driver.press(*SIDES)
        assert driver.states == PAUSED
    for arm in SIDES:
        assert np.linalg.norm(driver.tools[arm].translation - start[arm].translation) < within, noise
        assert angle(driver.tools[arm], start[arm]) < 1e-3
    assert np.mean(after_engaging) < within / 10.0


@pytest.mark.parametrize("turning", [0.1, 6.0])
def test_the_mean_rotation_of_a_resting_hand_is_exact_after_a_turn_of_any_size(turning: float) -> None:
    filtered = Filtered()
    filtered.run(2.0, turning=turning)
    filtered.run(4.0)
    settled = [angle(se3_of(one), filtered.hand) for one in filtered.drawn[-250:]]
    assert max(settled) < TURN_NOISE / 2.0, "a mean of 150 samples; the filter alone leaves more than that"
