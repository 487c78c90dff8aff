from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.control.safety.joint_limits import JointLimits, VelocityBox, fastest_towards, next_velocity_box
from q2r2_control.types import Array

JOINTS = 60  # Number of joints that are tested at the same time.
STEPS = 800
RETURN_SPEED = 0.2
# Tolerance for the accumulated rounding of positions.
EXACT = 1e-9


def _bounds(random: np.random.Generator, longest: float) -> JointLimits:
    middle, half = random.uniform(-2, 2, JOINTS), 0.5 * 10.0 ** random.uniform(-2, 0.7, JOINTS)
    v, a = 10.0 ** random.uniform(-1, 0.7, JOINTS), 10.0 ** random.uniform(0, 1.5, JOINTS)
    return JointLimits(middle - half, middle + half, v, a, longest, RETURN_SPEED)


def _box(q: Array, v: Array, bounds: JointLimits, h: float) -> tuple[VelocityBox, bool]:
    box = VelocityBox.empty(len(q))
    return box, next_velocity_box(bounds, q, v, h, box)


def _stoppable(room: Array, v: Array, bounds: JointLimits) -> npt.NDArray[np.bool_]:
    """Return for each joint whether condition P of joint_limits.py holds towards one limit, to within rounding."""
    return np.where(
        v <= 0.0, room >= -EXACT, v**2 / (2 * bounds.acceleration) + bounds.longest_step * v <= room + EXACT
    )


def _keeps_p(q: Array, v: Array, bounds: JointLimits) -> bool:
    up, down = _stoppable(bounds.upper - q, v, bounds), _stoppable(q - bounds.lower, -v, bounds)
    return bool((up & down & (np.abs(v) <= bounds.velocity + EXACT)).all())


def _fastest_in_p(room: Array, bounds: JointLimits) -> Array:
    """Return the largest speed for which condition P of joint_limits.py holds at the distance ``room`` from a limit."""
    a, H = bounds.acceleration, bounds.longest_step
    return np.minimum(bounds.velocity, -a * H + np.sqrt((a * H) ** 2 + 2 * a * np.maximum(room, 0.0)))


def _start_on_the_edge_of_p(random: np.random.Generator, bounds: JointLimits) -> tuple[Array, Array]:
    q = random.uniform(bounds.lower, bounds.upper)
    share: Array = random.choice(np.array([0.0, 0.5, 1.0]), len(q))
    upward = random.random(len(q)) < 0.5
    return q, share * np.where(
        upward, _fastest_in_p(bounds.upper - q, bounds), -_fastest_in_p(q - bounds.lower, bounds)
    )


Choice = Callable[[VelocityBox, Array, np.random.Generator], Array]
CHOICES: dict[str, Choice] = {
    "upwards": lambda box, v, random: box.upper,
    "turning": lambda box, v, random: np.where(random.random(len(v)) < 0.02, box.lower, box.upper),
    "either corner": lambda box, v, random: np.where(random.random(len(v)) < 0.5, box.lower, box.upper),
    "anything": lambda box, v, random: box.lower + random.random(len(v)) * (box.upper - box.lower),
}


@pytest.mark.parametrize("longest", [0.0005, 0.02], ids="longest step {} s".format)
@pytest.mark.parametrize("choose", CHOICES.values(), ids=CHOICES.keys())
def test_any_velocity_from_the_velocity_box_keeps_every_limit_at_steps_and_between_them(
    choose: Choice, longest: float
) -> None:
    random = np.random.default_rng(6)
    bounds = _bounds(random, longest)
    q, v = _start_on_the_edge_of_p(random, bounds)
    for _ in range(STEPS):
        h = longest * random.choice([1.0, 1.0, 0.5, 1e-3, random.uniform(1e-6, 1.0)])
        box, inside = _box(q, v, bounds, h)
        assert inside
        braked = v - np.clip(v, -bounds.acceleration * h, bounds.acceleration * h)
        assert (box.lower <= braked + EXACT).all()
        assert (braked <= box.upper + EXACT).all()
        chosen = choose(box, v, random)
        assert (np.abs(chosen - v) <= bounds.acceleration * h * (1 + EXACT) + 1e-15).all()
        for share in (0.25, 0.5, 0.75, _turning_point(v, chosen)):
            t = share * h
            between = q + v * t + 0.5 * (chosen - v) / h * t**2
            assert (bounds.lower - EXACT <= between).all()
            assert (between <= bounds.upper + EXACT).all()
        q, v = q + 0.5 * h * (v + chosen), chosen
        assert _keeps_p(q, v, bounds)


def _turning_point(v: Array, chosen: Array) -> Array:
    """Return for each joint the fraction of the step after which it reverses, or 1 if it does not reverse."""
    turns = v * chosen < 0.0
    return np.where(turns, v / np.where(turns, v - chosen, 1.0), 1.0)


@given(
    room=st.floats(0.0, 10.0),
    share=st.floats(0.0, 1.0),
    a=st.floats(0.1, 100.0),
    longest=st.floats(1e-4, 0.02),
    part=st.floats(1e-3, 1.0),
)
@settings(derandomize=True, max_examples=500, deadline=None)
def test_the_velocity_bound_is_the_largest_velocity_from_which_a_joint_can_still_stop_at_its_limit(
    room: float, share: float, a: float, longest: float, part: float
) -> None:
    h = part * longest
    v = share * (-a * longest + np.sqrt((a * longest) ** 2 + 2 * a * room))
    bound = fastest_towards(room, v, a, h, longest, RETURN_SPEED)
    left = room - 0.5 * h * (v + bound)
    assert bound**2 / (2 * a) + longest * bound == pytest.approx(left, abs=EXACT)
    assert bound >= v - a * h - EXACT


def _recover(q: Array, v: Array, bounds: JointLimits, choose: Choice, seconds: float) -> tuple[Array, Array]:
    """Return positions and velocities (t, n) of joints. Condition P of joint_limits.py does not hold at their start.

    The acceleration is checked at every step.
    """
    random, h = np.random.default_rng(7), bounds.longest_step
    positions, velocities = [q], [v]
    for _ in range(int(seconds / h)):
        box, _ = _box(q, v, bounds, h)
        assert (box.lower <= box.upper).all()
        chosen = choose(box, v, random)
        assert (np.abs(chosen - v) <= bounds.acceleration * h * (1 + EXACT) + 1e-15).all()
        q, v = q + 0.5 * h * (v + chosen), chosen
        positions.append(q)
        velocities.append(v)
    assert _box(q, v, bounds, h)[1]
    assert _keeps_p(q, v, bounds)
    return np.array(positions), np.array(velocities)


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["above", "below"])
@pytest.mark.parametrize("choose", CHOICES.values(), ids=CHOICES.keys())
def test_a_joint_outside_its_limits_returns_without_a_jump_at_bounded_speed(choose: Choice, side: float) -> None:
    ones = np.ones(JOINTS)
    bounds = JointLimits(-2.0 * ones, 2.0 * ones, 1.5 * ones, 10.0 * ones, 0.002, RETURN_SPEED)
    outside = np.linspace(1e-6, 0.3, JOINTS)
    start = side * (2.0 + outside)
    assert not _box(start, np.zeros(JOINTS), bounds, 0.002)[1]
    positions, velocities = _recover(start, np.zeros(JOINTS), bounds, choose, 3.5)
    beyond = side * positions - 2.0
    while_outside = beyond[:-1] > 0.0
    assert (np.diff(beyond, axis=0)[while_outside] <= EXACT).all(), "never further out"
    assert (side * velocities[:-1][while_outside] <= EXACT).all()
    if choose is CHOICES["upwards"] and side > 0.0:
        assert (-velocities[1:][while_outside] <= RETURN_SPEED + EXACT).all(), "no faster inward than asked for"
