from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.control.kernel_model import KernelData
from q2r2_control.control.safety.joint_limits import next_velocity_box
from q2r2_control.control.safety.safety_data import ROUNDING, VelocityBox
from q2r2_control.control.safety.stop_certificate import certify, step_travel
from q2r2_control.control.safety.stop_rollout import ARM_BY_ARM, OWN, SHAPES, TOGETHER, brake, write_stop
from q2r2_control.types import Array
from tests.control.cells import NAMES, CellArrays, cell, distances, kernel_data, kernel_model, move_data, random_posture
from tests.control.safety.motions import ACCELERATION, DENSE, H, Motion, motion_of

MIN_DISTANCE = 0.02


@given(v=st.floats(-3, 3), v_next=st.floats(-3, 3), h=st.floats(1e-5, 0.02))
@settings(derandomize=True, max_examples=200, deadline=None)
def test_the_travel_of_a_step_is_the_sum_of_its_motions_in_both_directions(v: float, v_next: float, h: float) -> None:
    t = np.linspace(0.0, h, 2001)
    q = v * t + 0.5 * (v_next - v) / h * t**2
    way = float(np.abs(np.diff(q)).sum())
    assert way - 1e-15 <= step_travel(v, v_next, h) <= way + 1e-6 * h * (abs(v) + abs(v_next)) + 1e-15


def _least(name: str, motion: Motion) -> Array:
    """Return the least distance (p,) of each pair along the whole motion [m], or a lower bound if the pair is far."""
    samples = np.concatenate([motion.step(), motion.stop()])
    return np.asarray(distances(cell(name), samples, exact_below=0.05).min(axis=0))


@cache
def _data(name: str) -> KernelData:
    return kernel_data(name, cell(name).robot.home)


def _certified(name: str, motion: Motion, known: Array | None = None) -> bool:
    model, data = kernel_model(name).safety, _data(name).safety
    move_data(name, _data(name), motion.q, motion.v)
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
    """Yield postures in which all pairs are apart. If ``near``, they are just before a collision on a random path."""
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
def test_nothing_comes_too_close_in_a_certified_motion_and_clearly_safe_motions_are_certified(
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
    """Yield two motions for each of ``count`` starts. Both have the same start and direction.

    In the first motion, a pair comes slightly closer than the required distance. The second motion is slower, and every
    pair keeps the required distance.
    """
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
def test_motions_that_are_slightly_too_fast_are_refused_and_clearly_slower_motions_are_mostly_certified(
    name: str, shape: int
) -> None:
    accepted = total = 0
    for number, motion in enumerate(_aimed_at_the_threshold(name, np.random.default_rng(16), 6, shape)):
        if number % 2 == 0:
            assert not _certified(name, motion), "it comes closer than the least distance"
        else:
            accepted, total = accepted + _certified(name, motion), total + 1
    assert total >= 5
    assert accepted >= 0.5 * total


def _swings(random: np.random.Generator, count: int, dip: float) -> Iterator[Motion]:
    """Yield steps that bring the nearest pair closer by ``dip`` [m] and away again.

    In the stop after the step, no pair is too close.
    """
    name, found = "dual_iiwa7", 0
    for q in _starts_apart(name, random, True, 20 * count):
        apart = distances(cell(name), q[None])[0]
        moved = distances(cell(name), q + 1e-6 * np.eye(len(q)))
        gradient = (moved[:, apart.argmin()] - apart.min()) / 1e-6
        norm = np.linalg.norm(gradient)
        start = q - (apart.min() - MIN_DISTANCE - 1e-4) * gradient / norm**2
        v = -4.0 * dip / H * gradient / norm**2
        motion = motion_of(name, start, v, -v)
        if min(distances(cell(name), way).min() for way in (start[None], motion.stop())) >= MIN_DISTANCE:
            found += 1
            yield motion
        if found == count:
            return


def test_a_step_is_refused_if_a_pair_comes_too_close_within_it_even_if_the_pair_is_apart_at_both_ends() -> None:
    swings = list(_swings(np.random.default_rng(21), 8, dip=5e-4))
    assert len(swings) == 8
    for motion in swings:
        assert distances(cell("dual_iiwa7"), motion.step()).min() < MIN_DISTANCE - 1e-4
        assert not _certified("dual_iiwa7", motion)
    assert sum(_certified("dual_iiwa7", motion) for motion in _swings(np.random.default_rng(21), 8, dip=2e-5)) >= 6


@pytest.mark.parametrize("name", NAMES)
def test_with_lower_bounds_instead_of_distances_no_unsafe_motion_is_certified(name: str) -> None:
    arrays, random = cell(name), np.random.default_rng(17)
    for motion in _motions_from(name, _starts_apart(name, random, True, 20), random):
        exact = distances(arrays, motion.q[None])[0]
        bounds = np.maximum(exact - random.uniform(0.0, 0.3, len(exact)), MIN_DISTANCE)
        if _certified(name, motion, np.minimum(bounds, exact)):
            assert _least(name, motion).min() >= MIN_DISTANCE


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


def test_a_step_that_brings_a_too_close_pair_closer_is_refused_even_if_the_pair_opens_at_its_end() -> None:
    name, found = "dual_iiwa7", 0
    for q in _too_close(cell(name), np.random.default_rng(22), 200):
        apart = distances(cell(name), q[None])[0]
        if np.partition(apart, 1)[1] < MIN_DISTANCE:
            continue  # The step might be refused because of a second pair that is too close.
        gradient = (distances(cell(name), q + 1e-6 * np.eye(len(q)))[:, apart.argmin()] - apart.min()) / 1e-6
        parting = 0.01 * gradient / np.linalg.norm(gradient) ** 2  # The pair parts at 0.01 m/s.
        if _certified(name, motion_of(name, q, parting, parting)):
            found += 1
            assert not _certified(name, motion_of(name, q, -4.0 * parting, parting))
    assert found >= 10


def test_rounding_errors_do_not_add_up_over_many_ticks() -> None:
    name, random = "dual_iiwa7", np.random.default_rng(23)
    for q in _starts_apart(name, random, True, 3):
        for _ in range(2):  # The iteration finds a start at which the pair is exactly at its required distance.
            apart = distances(cell(name), q[None])[0]
            pair = apart.argmin()
            gradient = (distances(cell(name), q + 1e-6 * np.eye(len(q)))[:, pair] - apart.min()) / 1e-6
            q = q - (apart.min() - MIN_DISTANCE) * gradient / np.linalg.norm(gradient) ** 2
        # The pair approaches at 5e-9 m/s, which is 5e-12 m per step.
        closing = -5e-9 * gradient / np.linalg.norm(gradient) ** 2
        for _ in range(400):
            motion = motion_of(name, q, np.zeros_like(q), closing)
            q = motion.q_next if _certified(name, motion) else q
        assert distances(cell(name), q[None])[0][pair] >= MIN_DISTANCE - 0.9 * ROUNDING


def _turning_at_its_end(name: str, random: np.random.Generator, count: int) -> Iterator[Motion]:
    """Yield the fastest certified stops in which all joints stop together, from postures in which a pair is too close.

    A faster stop would bring a pair closer again at its end.
    """
    found = 0
    for motion in _motions_from(name, _too_close(cell(name), random, 2000), random):
        known = distances(cell(name), motion.q[None])[0]

        def stops(share: float, motion: Motion = motion, known: Array = known) -> bool:
            v = share * motion.v
            return _certified(name, motion_of(name, motion.q, v, v, TOGETHER), known)

        if not stops(0.05):
            continue
        low, high = 0.05, 1.0
        for _ in range(20):
            share = 0.5 * (low + high)
            low, high = (share, high) if stops(share) else (low, share)
        if high < 1.0:
            found += 1
            yield motion_of(name, motion.q, low * motion.v, low * motion.v, TOGETHER)
        if found == count:
            return


def test_a_pair_that_starts_too_close_comes_no_closer_between_the_samples_of_its_stop_either() -> None:
    name = "dual_iiwa7"
    arrays, found = cell(name), 0
    for motion in _turning_at_its_end(name, np.random.default_rng(20), 10):
        found += 1
        close = np.flatnonzero(distances(arrays, motion.q[None])[0] < MIN_DISTANCE)
        way = distances(arrays, motion.stop(20 * DENSE), exact_below=MIN_DISTANCE, pairs=close)
        # A pair that has reached its required distance may come closer again, down to this distance.
        fall = np.where(way[1:] < MIN_DISTANCE, way[:-1] - way[1:], 0.0)
        assert fall.max() < 1e-9
    assert found == 10


MODEL = kernel_model("dual_iiwa7").safety
HOME = cell("dual_iiwa7").robot.home
SEEDS = st.integers(0, 2**32 - 1)


def _braked(q: Array, v: Array, a: Array, t: float) -> tuple[Array, Array]:
    q_out, v_out = np.zeros_like(q), np.zeros_like(v)
    brake(q, v, a, t, q_out, v_out)
    return q_out, v_out


def _some_stop(seed: int) -> tuple[Array, Array, Array]:
    random = np.random.default_rng(seed)
    v = random.uniform(-3, 3, 14)
    v[:3] = 0.0, -0.0, 1e-12
    return random.uniform(-3, 3, 14), v, 10.0 ** random.uniform(0, 1.5, 14)


def test_every_joint_stops_after_its_own_time_and_distance() -> None:
    q, v, a = _some_stop(14)
    end, rest = _braked(q, v, a, 100.0)
    np.testing.assert_array_equal(rest, 0.0)
    np.testing.assert_allclose(end, q + np.sign(v) * v**2 / (2 * a), rtol=0, atol=1e-15)
    times = np.abs(v) / a
    for t in np.linspace(0.0, 1.2 * times.max(), 40):
        ran = np.minimum(t, times)
        between, speed = _braked(q, v, a, t)
        np.testing.assert_allclose(between, q + v * ran - np.sign(v) * a * ran**2 / 2, rtol=0, atol=1e-14)
        np.testing.assert_allclose(speed, v - np.sign(v) * a * ran, rtol=0, atol=1e-14)


@given(seed=st.integers(0, 1000), parts=st.lists(st.floats(1e-6, 0.1), min_size=1, max_size=40))
@settings(derandomize=True, max_examples=100, deadline=None)
def test_the_stop_is_the_same_motion_for_any_lengths_of_ticks(seed: int, parts: list[float]) -> None:
    q, v, a = _some_stop(seed)
    expected = _braked(q, v, a, float(np.sum(parts)))
    for t in parts:
        q, v = _braked(q, v, a, t)
    np.testing.assert_allclose(q, expected[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(v, expected[1], rtol=0, atol=1e-12)


def _decelerations(q: Array, v: Array, shape: int) -> Array:
    out = np.zeros(14)
    write_stop(MODEL, q, v, shape, out)
    return out


def _random_velocities(seed: int) -> Array:
    return np.random.default_rng(seed).uniform(-MODEL.limits.velocity, MODEL.limits.velocity)


@given(seed=SEEDS)
@settings(derandomize=True, max_examples=50, deadline=None)
def test_joints_that_stop_together_move_on_a_straight_line_in_joint_space(seed: int) -> None:
    v = _random_velocities(seed)
    deceleration = _decelerations(HOME, v, TOGETHER)
    duration = np.abs(v / MODEL.limits.acceleration).max()
    np.testing.assert_allclose(np.abs(v) / deceleration, duration, rtol=1e-12)
    ways = np.array([_braked(HOME, v, deceleration, t)[0] - HOME for t in np.linspace(0.0, duration, 20)])
    np.testing.assert_allclose(ways, ways[:, :1] / v[0] * v, rtol=0, atol=1e-12)


@given(seed=SEEDS)
@settings(derandomize=True, max_examples=50, deadline=None)
def test_in_a_stop_arm_by_arm_each_arm_takes_the_time_of_its_slowest_joint(seed: int) -> None:
    v = _random_velocities(seed)
    v[7:] *= 0.1
    times = np.abs(v) / _decelerations(HOME, v, ARM_BY_ARM)
    for arm in cell("dual_iiwa7").robot.arms.values():
        slowest = np.max(np.abs(v[arm.joints]) / MODEL.limits.acceleration[arm.joints])
        np.testing.assert_allclose(times[arm.joints], slowest, rtol=1e-12)


@pytest.mark.parametrize("shape", range(SHAPES), ids=["together", "arm by arm", "own"])
@given(seed=SEEDS)
@settings(derandomize=True, max_examples=200, deadline=None)
def test_every_kind_of_stop_keeps_position_limits_at_every_moment(shape: int, seed: int) -> None:
    """Each joint starts at, or below, the speed that condition P of joint_limits.py allows at its distance.

    A slow joint that stops together with a fast joint moves for a long time, and must not drift beyond its limit.
    """
    random, limits, h = np.random.default_rng(seed), MODEL.limits, 0.001
    room = 10.0 ** random.uniform(-6, 0, 14)
    ahead = np.asarray(random.choice([-1.0, 1.0], 14), dtype=float)
    limit = np.where(ahead > 0, limits.upper, limits.lower)
    q = limit - ahead * room
    # This is the largest speed that P allows: v^2 / 2a + H v = room.
    a, longest = limits.acceleration, limits.longest_step
    fastest = np.minimum(a * (-longest + np.sqrt(longest**2 + 2 * room / a)), limits.velocity)
    v = ahead * fastest * np.asarray(random.choice([1.0 - 1e-9, 0.5, 0.01], 14), dtype=float)
    deceleration = _decelerations(q, v, shape)
    assert (deceleration > 0.0).all()
    assert (deceleration <= a * (1 + 1e-12)).all()
    for t in np.linspace(0.0, np.max(np.abs(v) / deceleration), 30):
        then, speed = _braked(q, v, deceleration, t)
        assert ((then <= limits.upper + 1e-12) & (then >= limits.lower - 1e-12)).all()
        assert next_velocity_box(limits, then, speed, h, VelocityBox.empty(14)), "P is lost during the stop"
