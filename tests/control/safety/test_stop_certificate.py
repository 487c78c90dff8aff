from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.control.safety.stop_certificate import certify, step_travel
from q2r2_control.control.safety.stop_rollout import OWN, SHAPES, TOGETHER
from q2r2_control.types import Array
from tests.control.cells import NAMES, CellArrays, cell, distances, kernel_data, kernel_model, random_posture
from tests.control.safety.motions import ACCELERATION, DENSE, H, Motion, motion_of

MIN_DISTANCE = 0.02


@given(v=st.floats(-3, 3), v_next=st.floats(-3, 3), h=st.floats(1e-5, 0.02))
@settings(derandomize=True, max_examples=200, deadline=None)
def test_the_way_of_a_step_counts_there_and_back(v: float, v_next: float, h: float) -> None:
    t = np.linspace(0.0, h, 2001)
    q = v * t + 0.5 * (v_next - v) / h * t**2
    way = float(np.abs(np.diff(q)).sum())
    assert way - 1e-15 <= step_travel(v, v_next, h) <= way + 1e-6 * h * (abs(v) + abs(v_next)) + 1e-15


def _least(name: str, motion: Motion) -> Array:
    """Least distance (p,) of each pair along the whole motion; only a bound where it is far."""
    samples = np.concatenate([motion.step(), motion.stop()])
    return np.asarray(distances(cell(name), samples, exact_below=0.05).min(axis=0))


def _certified(name: str, motion: Motion, known: Array | None = None) -> bool:
    model, data = kernel_model(name).safety, kernel_data(name, motion.q, motion.v).safety
    data.distance[:] = distances(cell(name), motion.q[None])[0] if known is None else known
    data.candidate.q[:] = motion.q_next
    data.candidate.v[:] = motion.v_next
    data.candidate.deceleration[:] = motion.deceleration
    return bool(certify(model, data, H))


def _motions_from(
    name: str, starts: Iterator[Array], random: np.random.Generator, shape: int = OWN
) -> Iterator[Motion]:
    limit = cell(name).robot.velocity_limit
    for q in starts:
        v = random.choice([0.1, 0.5, 1.0]) * random.uniform(-limit, limit)
        yield motion_of(name, q, v, v + random.uniform(-1, 1, 14) * ACCELERATION * H, shape)


def _starts_apart(name: str, random: np.random.Generator, near: bool, count: int) -> Iterator[Array]:
    """Postures with every pair apart; ``near``: on the way from one into a collision, just before it."""
    arrays, found = cell(name), 0
    while found < count:
        q, other = random_posture(arrays.robot, random), random_posture(arrays.robot, random)
        if distances(arrays, q[None])[0].min() < MIN_DISTANCE:
            continue
        if near:
            way = q + np.linspace(0.0, 1.0, 200)[:, None] * (other - q)
            apart = distances(arrays, way).min(axis=1) >= MIN_DISTANCE
            if apart.all():
                continue
            q = way[np.argmin(apart) - 1]
        found += 1
        yield q


@pytest.mark.parametrize("shape", range(SHAPES), ids=["together", "arm by arm", "own"])
@pytest.mark.parametrize("near", [False, True], ids=["anywhere", "just before contact"])
@pytest.mark.parametrize("name", NAMES)
def test_nothing_comes_too_close_in_a_certified_motion_and_what_is_safe_by_far_is_certified(
    name: str, near: bool, shape: int
) -> None:
    random = np.random.default_rng(15)
    refused = certified = clearly_safe = 0
    for motion in _motions_from(name, _starts_apart(name, random, near, 40), random, shape):
        least = _least(name, motion).min()
        if _certified(name, motion):
            certified += 1
            assert least >= MIN_DISTANCE
        elif least >= MIN_DISTANCE + 0.02:
            refused += 1
        clearly_safe += bool(least >= MIN_DISTANCE + 0.02)
    assert certified > 5
    assert refused == 0, "safe by 20 mm"
    assert near or clearly_safe > 5


def _aimed_at_the_threshold(name: str, random: np.random.Generator, count: int, shape: int) -> Iterator[Motion]:
    """Motions whose speed is scaled so that their stop ends within a hair of the least distance."""
    found = 0
    for motion in _motions_from(name, _starts_apart(name, random, True, 10 * count), random):
        low, high = 0.0, 2.0
        for _ in range(8):
            share = 0.5 * (low + high)
            scaled = motion_of(name, motion.q, share * motion.v, share * motion.v, shape)
            if _least(name, scaled).min() >= MIN_DISTANCE:
                low = share
            else:
                high = share
        if low > 0.0 and high < 2.0:
            found += 1
            yield motion_of(name, motion.q, 1.01 * high * motion.v, 1.01 * high * motion.v, shape)
            yield motion_of(name, motion.q, 0.8 * low * motion.v, 0.8 * low * motion.v, shape)
        if found == count:
            return


@pytest.mark.parametrize("shape", range(SHAPES), ids=["together", "arm by arm", "own"])
@pytest.mark.parametrize("name", ["dual_iiwa7", "dual_panda"])
def test_the_certificate_tells_motions_apart_that_end_just_inside_and_well_outside(name: str, shape: int) -> None:
    accepted = total = 0
    for number, motion in enumerate(_aimed_at_the_threshold(name, np.random.default_rng(16), 6, shape)):
        if number % 2 == 0:
            assert not _certified(name, motion), "it comes closer than the least distance"
        else:
            accepted, total = accepted + _certified(name, motion), total + 1
    assert total >= 5
    assert accepted >= 0.5 * total


@pytest.mark.parametrize("name", NAMES)
def test_lower_bounds_in_place_of_distances_prove_nothing_that_is_not_so(name: str) -> None:
    arrays, random = cell(name), np.random.default_rng(17)
    for motion in _motions_from(name, _starts_apart(name, random, True, 20), random):
        exact = distances(arrays, motion.q[None])[0]
        bounds = np.maximum(exact - random.uniform(0.0, 0.3, len(exact)), MIN_DISTANCE)
        if _certified(name, motion, np.minimum(bounds, exact)):
            assert _least(name, motion).min() >= MIN_DISTANCE


@pytest.mark.parametrize("name", NAMES)
def test_rest_with_everything_apart_is_certified(name: str) -> None:
    random, still = np.random.default_rng(18), np.zeros(14)
    for q in _starts_apart(name, random, True, 20):
        assert _certified(name, motion_of(name, q, still, still))


def _too_close(arrays: CellArrays, random: np.random.Generator, count: int) -> Iterator[Array]:
    found = 0
    while found < count:
        q = random_posture(arrays.robot, random)
        if distances(arrays, q[None])[0].min() < MIN_DISTANCE:
            found += 1
            yield q


@pytest.mark.parametrize("name", NAMES)
def test_a_pair_that_starts_too_close_comes_no_closer_in_a_certified_motion(name: str) -> None:
    arrays, random = cell(name), np.random.default_rng(19)
    certified = 0
    for motion in _motions_from(name, _too_close(arrays, random, 100), random):
        slow = motion_of(name, motion.q, 0.1 * motion.v, 0.1 * motion.v)
        if not _certified(name, slow):
            continue
        certified += 1
        before = distances(arrays, slow.q[None])[0]
        close = before < MIN_DISTANCE
        during = _least(name, slow)
        assert (during[close] >= before[close] - 1e-6).all()
        assert (during[~close] >= MIN_DISTANCE).all()
    assert certified > 3


def _turning_at_its_end(name: str, random: np.random.Generator, count: int) -> Iterator[Motion]:
    """Stops of all joints together out of postures that are too close, the fastest that are certified.

    A faster one brings a pair closer again, at its end.
    """
    found = 0
    for motion in _motions_from(name, _too_close(cell(name), random, 2000), random):
        low, high = 0.0, 1.0
        for _ in range(20):
            share = 0.5 * (low + high)
            v = share * motion.v
            low, high = (share, high) if _certified(name, motion_of(name, motion.q, v, v, TOGETHER)) else (low, share)
        if low > 0.05 and high < 1.0:
            found += 1
            yield motion_of(name, motion.q, low * motion.v, low * motion.v, TOGETHER)
        if found == count:
            return


def test_a_pair_that_starts_too_close_comes_no_closer_between_the_samples_of_its_stop_either() -> None:
    name = "dual_iiwa7"
    arrays, found = cell(name), 0
    for motion in _turning_at_its_end(name, np.random.default_rng(20), 10):
        found += 1
        close = distances(arrays, motion.q[None])[0] < MIN_DISTANCE
        way = distances(arrays, motion.stop(20 * DENSE), exact_below=MIN_DISTANCE)[:, close]
        # A pair that has come free may come closer again, as far as its distance.
        fall = np.where(way[1:] < MIN_DISTANCE, way[:-1] - way[1:], 0.0)
        assert fall.max() < 1e-9
    assert found == 10
