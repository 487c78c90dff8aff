from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.safety.joint_limits import ACCELERATION, next_velocity_box
from q2r2_control.control.safety.safety_data import SafetyData
from q2r2_control.control.safety.safety_filter import (
    FOLLOWED,
    SEPARATION,
    STOPPED,
    apply_safety_filter,
    certify_start,
)
from q2r2_control.control.safety.stop_rollout import brake
from q2r2_control.types import Array
from tests.control.cells import cell, distances, kernel_data, kernel_model

MODEL = kernel_model("dual_iiwa7").safety
HOME = cell("dual_iiwa7").robot.home
V = np.linspace(-0.2, 0.2, 14)
H = 0.002


def started() -> SafetyData:
    """Return the data of a filter. The arms move slowly at home, with a certified stop and the next velocity box."""
    data = kernel_data("dual_iiwa7", HOME, V).safety
    data.distance[:] = distances(cell("dual_iiwa7"), HOME[None])[0]
    assert certify_start(MODEL, data)
    assert next_velocity_box(MODEL.limits, HOME, V, H, data.box)
    return data


def moved(data: SafetyData, wish: Array, usable: bool = True) -> int:
    """Do one step of the filter with the solver's velocities ``wish`` (nv,) [rad/s], and return its outcome."""
    outcome, _ = apply_safety_filter(MODEL, data, wish, usable, H, 1.0)
    return int(outcome)


def test_a_solution_within_the_velocity_box_and_far_from_collisions_is_executed_unchanged() -> None:
    data, wish = started(), V + np.linspace(0.008, -0.008, 14)
    assert moved(data, wish) == FOLLOWED
    np.testing.assert_array_equal(data.state.v, wish)
    np.testing.assert_allclose(data.state.q, HOME + 0.5 * H * (V + wish), rtol=0, atol=1e-15)
    np.testing.assert_allclose(data.state.a, (wish - V) / H, rtol=1e-9)
    assert data.active.used[0] == 0


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_solution_beyond_the_velocity_box_is_clamped_for_each_joint_and_the_joint_is_named(direction: float) -> None:
    data, wish = started(), V.copy()
    wish[3] = direction * 1e12
    assert moved(data, wish) == FOLLOWED
    assert data.state.v[3] == pytest.approx(V[3] + direction * 10.0 * H)
    np.testing.assert_array_equal(np.delete(data.state.v, 3), np.delete(V, 3))
    assert data.active.used[0] == 1
    assert (data.active.kind[0], data.active.subject[0]) == (ACCELERATION, 3)


@pytest.mark.parametrize("number", [np.nan, np.inf])
@pytest.mark.parametrize("joint", [0, 13])
def test_a_solution_with_one_number_that_is_not_finite_leads_to_the_certified_stop(number: float, joint: int) -> None:
    data, wish = started(), V.copy()
    wish[joint] = number
    assert moved(data, wish) == STOPPED
    q, v = np.zeros(14), np.zeros(14)
    brake(HOME, V, data.certified, H, q, v)
    np.testing.assert_array_equal(data.state.q, q)
    np.testing.assert_array_equal(data.state.v, v)


def test_an_unusable_solution_is_not_executed() -> None:
    data = started()
    assert moved(data, V, usable=False) == STOPPED
    assert (np.abs(data.state.v) <= np.abs(V)).all()


def test_if_nothing_can_be_certified_each_pair_that_is_too_close_is_named() -> None:
    data = started()
    data.state.v[:] = 0.0
    pairs = np.argsort(data.distance)[:2].tolist()
    kept = MODEL.min_distance.copy()
    try:
        MODEL.min_distance[pairs] = data.distance[pairs] + 0.01
        assert moved(data, np.full(14, np.nan)) == STOPPED
    finally:
        MODEL.min_distance[:] = kept
    active = data.active
    named = [subject for kind, subject in zip(active.kind, active.subject, strict=True) if kind == SEPARATION]
    assert named == sorted(pairs)
