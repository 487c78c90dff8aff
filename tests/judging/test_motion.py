"""Smoothness says how a motion goes, not how long it takes, how fast it is, or how often it is repeated."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.inputs.assembly import minimum_jerk
from q2r2_control.judging.motion import ldlj, smoothness
from q2r2_control.types import Array

DT = 0.01


def reach(duration: float = 1.0, way: float = 0.2) -> Array:
    """One reach of minimum jerk, (k, 3)."""
    share = np.array([minimum_jerk(t / duration) for t in np.arange(0.0, duration + 0.5 * DT, DT)])
    return way * share[:, None] * np.array([0.6, 0.0, 0.8])


def to_and_fro(seconds: float, noise: float = 0.0) -> tuple[Array, Array]:
    """Times and places of reaches that follow each other."""
    t = np.arange(0.0, seconds, DT)
    phase = np.array([minimum_jerk(time % 1.0) for time in t])
    share = np.where(np.floor(t) % 2 == 0, phase, 1.0 - phase)
    place = 0.2 * share[:, None] * np.array([0.6, 0.0, 0.8])
    return t, place + np.random.default_rng(0).normal(0.0, noise, place.shape)


def test_a_reach_of_minimum_jerk_has_the_value_of_the_definition() -> None:
    # Of x(s) = 10 s^3 - 15 s^4 + 6 s^5 the integral of the squared jerk is 720, and the peak speed 15 / 8.
    assert ldlj(reach(), DT) == pytest.approx(-np.log(720.0 / (15.0 / 8.0) ** 2), abs=0.12)


def test_it_does_not_depend_on_the_size_of_a_motion() -> None:
    assert ldlj(reach(way=0.02), DT) == pytest.approx(ldlj(reach(way=0.5), DT), rel=1e-6)


def test_a_motion_that_stops_and_goes_is_less_smooth() -> None:
    shorter = reach(0.25, 0.05)
    in_four = np.concatenate([shorter[:-1] + step * shorter[-1] for step in range(4)])
    assert ldlj(in_four, DT) < ldlj(reach(), DT) - 0.5


def test_an_episode_twice_as_long_is_as_smooth() -> None:
    short, long = (smoothness(*to_and_fro(seconds), np.ones(int(seconds / DT), dtype=bool)) for seconds in (4.0, 8.0))
    assert short == pytest.approx(long, abs=0.05)


def test_noise_shows() -> None:
    everywhere = np.ones(400, dtype=bool)
    still = smoothness(*to_and_fro(4.0), everywhere)
    noisy = smoothness(*to_and_fro(4.0, noise=1e-3), everywhere)
    assert noisy is not None
    assert still is not None
    assert noisy < still - 3.0


def test_only_what_moves_while_engaged_counts() -> None:
    t, place = to_and_fro(8.0)
    place[400:] = place[400]
    engaged = np.ones(800, dtype=bool)
    assert smoothness(t, place, engaged) == pytest.approx(smoothness(t[:500], place[:500], engaged[:500]), abs=0.1)
    engaged[:400] = False
    assert smoothness(t, place, engaged) is None


def test_a_hand_that_trembles_at_rest_is_no_motion() -> None:
    t = np.arange(0.0, 4.0, DT)
    place = 2e-4 * np.sin(60.0 * t)[:, None] * np.array([1.0, 0.0, 0.0])
    assert smoothness(t, place, np.ones(len(t), dtype=bool)) is None


def test_what_is_missing_in_the_file_is_not_made_up() -> None:
    t, place = to_and_fro(6.0)
    there = t % 0.5 < 0.4
    assert smoothness(t[there], place[there], np.ones(there.sum(), dtype=bool)) is None


def test_what_is_no_number_is_left_out() -> None:
    t, place = to_and_fro(6.0)
    place[10] = np.nan
    found = smoothness(t, place, np.ones(600, dtype=bool))
    assert found == pytest.approx(smoothness(t[11:], place[11:], np.ones(589, dtype=bool)))
