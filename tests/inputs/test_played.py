"""Errors of a headset are added to exact poses: noise and uneven times, and on request also tremor and dropouts."""

from __future__ import annotations

import math
from itertools import islice

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.inputs.played import EvenSampling, HeadsetSampling, SampleTiming
from q2r2_control.types import Array

HAND = pin.SE3(pin.exp3(np.array([0.3, -0.2, 0.9])), np.array([0.4, 0.2, 1.1]))


def measured(sampling: SampleTiming, count: int) -> tuple[Array, Array]:
    """Sample a resting hand. Return the times (n,) [s] and the errors (n, 6) of position [m] and rotation [rad]."""
    times, added = [], []
    for t in islice(sampling.times(), count):
        pose = sampling.measured(HAND, t)
        times.append(t)
        added.append(np.r_[pose.translation - HAND.translation, pin.log3(pose.rotation @ HAND.rotation.T)])
        assert 0.0 <= sampling.lateness() <= 0.01
    return np.array(times), np.array(added)


def test_evenly_spaced_samples_are_exact_and_received_without_delay() -> None:
    times, added = measured(EvenSampling(50.0), 101)
    np.testing.assert_allclose(times, 0.02 * np.arange(101), rtol=1e-15)
    np.testing.assert_allclose(added, 0.0, atol=1e-12)
    assert EvenSampling(50.0).lateness() == 0.0


@pytest.mark.parametrize("noise", [1e-4, 2e-4])
def test_headset_noise_has_the_wanted_size_and_no_sample_is_lost(noise: float) -> None:
    times, added = measured(HeadsetSampling("left", 3, position_noise=noise), 4000)
    np.testing.assert_allclose(added.std(axis=0), [noise] * 3 + [math.radians(0.03)] * 3, rtol=0.05)
    np.testing.assert_allclose(added.mean(axis=0), 0.0, atol=0.1 * math.radians(0.03))
    gaps = np.diff(times)
    assert 1.0 / 76.0 <= gaps.min() < 1.0 / 75.5
    assert 1.0 / 72.5 < gaps.max() <= 1.0 / 72.0


def test_tremor_and_dropouts_have_the_wanted_size_and_length() -> None:
    times, added = measured(HeadsetSampling("right", 3, tremor=True, dropout_probability=0.005), 4000)
    assert 0.3e-3 < added[:, :3].std(axis=0).max() < 1e-3
    assert 0.02 < np.diff(times).max() < 6.0 / 72.0
