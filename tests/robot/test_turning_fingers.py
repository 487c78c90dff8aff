"""The body of a turning finger contains the finger at every opening of its interval, and hardly more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.control.geometry.collision import collision_model_of
from q2r2_control.control.geometry.finger_openings import FingerOpenings
from q2r2_control.robot.finger_bodies import collision_model_at
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.turning_fingers import (
    Capsules,
    FingerJoint,
    TurningBody,
    TurningSweeps,
    sticks_out,
)
from q2r2_control.types import ALL_OF_THE_WAY, Array, Interval
from tests.support.turning_hand import RealHands, turning_cell

OPENINGS = 200
Hand = tuple[Robot, RealHands, dict[str, TurningBody]]


def outside(points: Array, body: tuple[Array, Array, float], radius: float) -> float:
    """Return how far the farthest ball of ``radius`` about one of ``points`` (n, 3) is outside a capsule [m]."""
    start, end, thick = body
    along = end - start
    share = np.clip((points - start) @ along / max(float(along @ along), 1e-30), 0.0, 1.0)
    return float(np.linalg.norm(points - start - share[:, None] * along, axis=1).max() + radius - thick)


@pytest.fixture(scope="module")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    robot = Robot.from_config(turning_cell(tmp_path_factory.mktemp("hand")))
    bodies = {body.name: body for body in robot.finger_bodies if isinstance(body, TurningBody)}
    return robot, RealHands(robot), bodies


def test_every_moving_link_of_the_hand_has_a_body_that_contains_its_shape(hand: Hand) -> None:
    _, real, bodies = hand
    assert {name for name in bodies if name.startswith("left_")} == set(real.fingers)
    random = np.random.default_rng(0)
    intervals: list[Interval] = [ALL_OF_THE_WAY, (0.0, 0.0), (1.0, 1.0), (0.3, 0.3)]
    intervals += [(float(a), float(b)) for a, b in np.sort(random.random((12, 2)), axis=1)]
    for name in real.fingers:
        at = {opening: real.ends("left", name, opening) for opening in np.linspace(0.0, 1.0, OPENINGS + 1).tolist()}
        for interval in intervals:
            found = [at[opening] for opening in at if interval[0] <= opening <= interval[1]]
            found += [real.ends("left", name, opening) for opening in interval]
            points, radius = np.concatenate([ends for ends, _ in found]), found[0][1]
            beyond = outside(points, bodies[name].capsule(interval), radius)
            assert -0.05 < beyond <= 0.0, (name, interval)


def test_at_one_opening_a_capsule_equals_its_finger_and_over_a_narrow_interval_of_openings_it_is_little_thicker(
    hand: Hand,
) -> None:
    _, real, bodies = hand
    for name in real.fingers:
        body = bodies[name]
        for opening in (0.0, 0.37, 1.0):
            start, end, radius = body.capsule((opening, opening))
            ends, drawn = real.ends("left", name, opening)
            np.testing.assert_allclose(np.sort([start, end], axis=0), np.sort(ends, axis=0), atol=1e-9)
            assert radius == pytest.approx(drawn, abs=1e-8)
        # A finger that moves by 44 mm over the whole stroke moves by 2.2 mm in a twentieth of it.
        assert body.capsule((0.5, 0.55))[2] - drawn < 0.0013


def test_the_controller_and_coal_use_the_same_bodies(hand: Hand) -> None:
    robot, _, bodies = hand
    kernels = collision_model_of(robot).bodies
    fingers = FingerOpenings(robot, kernels)
    names = [item.name for item in robot.collision_model.geometryObjects]
    for interval in (ALL_OF_THE_WAY, (0.2, 0.9), (0.4, 0.41), ALL_OF_THE_WAY):
        fingers.set("left", interval)
        model = collision_model_at(robot.collision_model, robot.finger_bodies, {"left": interval})
        for name in bodies:
            item, number = model.geometryObjects[model.getGeometryId(name)], names.index(name)
            half = item.geometry.halfLength * item.placement.rotation[:, 2]
            np.testing.assert_allclose(item.placement.translation - half, kernels.start[number], atol=1e-12)
            np.testing.assert_allclose(item.placement.translation + half, kernels.end[number], atol=1e-12)
            assert item.geometry.radius == kernels.radius[number]
            assert kernels.size[number] == pytest.approx(item.geometry.halfLength + item.geometry.radius, abs=1e-12)


def test_no_capsule_for_any_interval_of_openings_extends_beyond_the_bounds_of_the_kernels(hand: Hand) -> None:
    robot, _, bodies = hand
    model, random = collision_model_of(robot), np.random.default_rng(1)
    names = [item.name for item in robot.collision_model.geometryObjects]
    for name, body in bodies.items():
        number = names.index(name)
        pairs = [p for p in range(len(model.pairs.first)) if number in (model.pairs.first[p], model.pairs.second[p])]
        last = int(model.bodies.joint[number])
        reach = [model.pairs.reach[p, list(model.pairs.joint[p]).index(last)] for p in pairs]
        for _ in range(30):
            low, high = np.sort(random.random(2)).tolist()
            start, end, _ = body.capsule((low, high))
            assert max(np.linalg.norm(start), np.linalg.norm(end)) <= min(reach) + 1e-12


# Hypothesis strategies for any chain of turning and sliding joints with one or two drivers.
_NUMBERS = st.floats(-0.1, 0.1)
_VECTORS = st.tuples(_NUMBERS, _NUMBERS, _NUMBERS)
_AXES = st.sampled_from([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.6, 0.8), (-0.48, 0.6, 0.64)])


@st.composite
def joints(draw: st.DrawFn) -> FingerJoint:
    slides = draw(st.booleans())
    size = 0.05 if slides else 1.6
    closed, opened, home = (size * draw(st.floats(-1.0, 1.0)) for _ in range(3))
    # The travel beyond the stroke is the same fraction of the stroke for all joints of one driver.
    beyond = 0.1 * (opened - closed)
    axis, point = np.array(draw(_AXES)), np.array(draw(_VECTORS))
    driver = draw(st.sampled_from("ab"))
    return FingerJoint(slides, axis, point, home, closed, opened, closed - beyond, opened + beyond, driver)


def moved(chain: Sequence[FingerJoint], ends: Array, at: dict[str, float], travel: bool = False) -> Array:
    """Return the ends (2, 3) of a shape [m].

    ``at`` has the opening of each driver, from 0 to 1, or with ``travel`` the fraction of the driver's whole travel.
    """
    for joint in reversed(chain):
        first, last = (joint.before, joint.beyond) if travel else (joint.closed, joint.open)
        by = first + at[joint.driver] * (last - first) - joint.home
        if joint.slides:
            ends = ends + by * joint.axis
        else:
            ends = (ends - joint.point) @ pin.AngleAxis(by, joint.axis).matrix().T + joint.point
    return ends


@pytest.mark.slow
@given(st.lists(joints(), min_size=1, max_size=4), _VECTORS, _VECTORS, st.tuples(st.floats(0, 1), st.floats(0, 1)))
@settings(max_examples=50, deadline=None)
def test_a_finger_at_the_end_of_any_chain_of_joints_is_inside_its_body(
    chain: list[FingerJoint], first: Array, second: Array, between: tuple[float, float]
) -> None:
    body = TurningBody("left", "finger_0", np.array([first, second]), 0.01, tuple(chain))
    random = np.random.default_rng(0)
    for interval in ((min(between), max(between)), ALL_OF_THE_WAY):
        capsule, travel = body.capsule(interval), interval == ALL_OF_THE_WAY
        at = random.uniform(*interval, (OPENINGS, 2))
        at[:4] = [(interval[a], interval[b]) for a in (0, 1) for b in (0, 1)]
        points = np.array([moved(chain, body.ends, dict(zip("ab", each, strict=True)), travel) for each in at])
        assert outside(points.reshape(-1, 3), capsule, body.radius) <= 0.0
        assert max(np.linalg.norm(capsule[0]), np.linalg.norm(capsule[1])) <= body.extent + 1e-12


def test_a_body_contains_the_positions_between_samples_even_if_there_are_few_samples() -> None:
    """Each driver turns by 6 rad, with as few samples as possible, because three drivers share them."""
    chain = [
        FingerJoint(False, np.array([0.0, 0.0, 1.0]), np.zeros(3), 0.0, -turn, turn, -turn, turn, driver)
        for driver, turn in (("a", 3.0), ("b", 3.0), ("c", 3.0))
    ]
    body = TurningBody("left", "finger_0", np.array([[0.1, 0.0, 0.0], [0.1, 0.0, 0.02]]), 0.005, tuple(chain))
    capsule, random = body.capsule(ALL_OF_THE_WAY), np.random.default_rng(0)
    for _ in range(OPENINGS):
        at = dict(zip("abc", random.random(3), strict=True))
        assert outside(moved(chain, body.ends, at), capsule, body.radius) <= 0.0


def test_a_capsule_is_inside_another_capsule_if_the_balls_at_both_of_its_ends_are_inside() -> None:
    outer = Capsules(np.zeros((1, 3)), np.array([[0.0, 0.0, 0.1]]), np.array([0.02]))
    inside = Capsules(np.array([[0.005, 0.0, 0.0]]), np.array([[0.0, 0.004, 0.1]]), np.array([0.014]))
    assert not sticks_out(inside, outer).any()
    for end in ([0.0, 0.007, 0.1], [0.0, 0.0, 0.107]):
        assert sticks_out(inside._replace(end=np.array([end])), outer).all()
    assert sticks_out(inside._replace(radius=np.array([0.016])), outer).all()


def test_bodies_that_are_computed_together_equal_bodies_computed_one_by_one_within_the_sampling_error(
    hand: Hand,
) -> None:
    _, _, bodies = hand
    together = TurningSweeps(list(bodies.values())).capsules((0.1, 0.4))
    for row, body in enumerate(bodies.values()):
        start, end, radius = body.capsule((0.1, 0.4))
        np.testing.assert_allclose(together.start[row], start, atol=5e-4)
        np.testing.assert_allclose(together.end[row], end, atol=5e-4)
        assert together.radius[row] == pytest.approx(radius, abs=1e-4)


def test_no_second_derivative_of_a_position_by_two_joints_exceeds_its_bound() -> None:
    """Differences are computed for chains of rotations and slides that one driver moves, anywhere on their travel."""
    random, h = np.random.default_rng(2), 1e-3
    nearest = np.zeros((3, 3))
    for _ in range(300):
        chain = []
        for _ in range(3):
            axis, slides = random.normal(size=3), bool(random.random() < 0.4)
            axis /= np.linalg.norm(axis)
            last = 0.3 if slides else 1.5
            chain.append(FingerJoint(slides, axis, random.uniform(-0.1, 0.1, 3), 0.0, -last, last, -last, last, "a"))
        body = TurningBody("left", "finger_0", random.uniform(-0.1, 0.1, (2, 3)), 0.01, tuple(chain))
        bounds, at = body.curvatures(), [random.uniform(joint.before, joint.beyond) for joint in chain]

        def ends(positions: Array, body: TurningBody = body) -> Array:
            alone = [replace(joint, driver=str(j)) for j, joint in enumerate(body.joints)]
            shares = {
                str(j): (by - joint.closed) / (joint.open - joint.closed)
                for j, (by, joint) in enumerate(zip(positions, alone, strict=True))
            }
            return moved(alone, body.ends, shares)

        for i, k in product(range(3), repeat=2):
            steps = h * np.eye(3)
            second = ends(at + steps[i] + steps[k]) - ends(at + steps[i] - steps[k])
            second -= ends(at - steps[i] + steps[k]) - ends(at - steps[i] - steps[k])
            found = float(np.linalg.norm(second, axis=1).max()) / (4.0 * h**2)
            assert found <= bounds[i, k] + 1e-6, (i, k)
            nearest[i, k] = max(nearest[i, k], found / max(bounds[i, k], 1e-9) if bounds[i, k] else 0.0)
    assert nearest.min() > 0.5  # A smaller ratio would show that the bounds are useless.
