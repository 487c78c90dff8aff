from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.control.safety.joint_limits import next_velocity_box
from q2r2_control.control.safety.safety_data import VelocityBox
from q2r2_control.control.safety.stop_rollout import ARM_BY_ARM, SHAPES, TOGETHER, brake, write_stop
from q2r2_control.types import Array
from tests.control.cells import cell, kernel_model

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


def test_every_joint_stops_after_its_own_time_and_way() -> None:
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
def test_the_stop_is_the_same_motion_however_it_is_cut_into_ticks(seed: int, parts: list[float]) -> None:
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
def test_joints_that_stop_together_go_straight_on_in_joint_space(seed: int) -> None:
    v = _random_velocities(seed)
    deceleration = _decelerations(HOME, v, TOGETHER)
    duration = np.abs(v / MODEL.limits.acceleration).max()
    np.testing.assert_allclose(np.abs(v) / deceleration, duration, rtol=1e-12)
    ways = np.array([_braked(HOME, v, deceleration, t)[0] - HOME for t in np.linspace(0.0, duration, 20)])
    np.testing.assert_allclose(ways, ways[:, :1] / v[0] * v, rtol=0, atol=1e-12)


@given(seed=SEEDS)
@settings(derandomize=True, max_examples=50, deadline=None)
def test_arm_by_arm_each_arm_stops_in_the_time_of_its_own_slowest_joint(seed: int) -> None:
    v = _random_velocities(seed)
    v[7:] *= 0.1
    times = np.abs(v) / _decelerations(HOME, v, ARM_BY_ARM)
    for arm in cell("dual_iiwa7").robot.arms.values():
        slowest = np.max(np.abs(v[arm.joints]) / MODEL.limits.acceleration[arm.joints])
        np.testing.assert_allclose(times[arm.joints], slowest, rtol=1e-12)


@pytest.mark.parametrize("shape", range(SHAPES), ids=["together", "arm by arm", "own"])
@given(seed=SEEDS)
@settings(derandomize=True, max_examples=200, deadline=None)
def test_every_shape_keeps_position_limits_at_every_moment_of_the_stop(shape: int, seed: int) -> None:
    """Every joint, near a limit or not, starts as fast as property P allows; the slow ones would drift on for long."""
    random, limits, h = np.random.default_rng(seed), MODEL.limits, 0.001
    room = 10.0 ** random.uniform(-6, 0, 14)
    ahead = random.choice([-1.0, 1.0], 14)
    limit = np.where(ahead > 0, limits.upper, limits.lower)
    q = limit - ahead * room
    # The largest speed that P allows: v^2 / 2a + H v = room.
    a, longest = limits.acceleration, limits.longest_step
    fastest = np.minimum(a * (-longest + np.sqrt(longest**2 + 2 * room / a)), limits.velocity)
    v = ahead * fastest * random.choice([1.0 - 1e-9, 0.5, 0.01], 14)
    deceleration = _decelerations(q, v, shape)
    assert (deceleration > 0.0).all()
    assert (deceleration <= a * (1 + 1e-12)).all()
    for t in np.linspace(0.0, np.max(np.abs(v) / deceleration), 30):
        then, speed = _braked(q, v, deceleration, t)
        assert ((then <= limits.upper + 1e-12) & (then >= limits.lower - 1e-12)).all()
        assert next_velocity_box(limits, then, speed, h, VelocityBox.empty(14)), "P is lost during the stop"


@pytest.mark.parametrize("shape", [TOGETHER, ARM_BY_ARM])
def test_a_joint_that_rests_is_left_at_rest_by_a_stop_of_the_others(shape: int) -> None:
    v = np.zeros(14)
    v[2] = 1.0
    deceleration = _decelerations(HOME, v, shape)
    end, rest = _braked(HOME, v, deceleration, 1.0)
    np.testing.assert_array_equal(np.delete(end, 2), np.delete(HOME, 2))
    np.testing.assert_array_equal(rest, 0.0)
