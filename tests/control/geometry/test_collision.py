from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from q2r2_control.control.geometry.collision import CollisionData, bodies_of, pairs_of
from q2r2_control.control.geometry.pair_distance import at_least, distance_row, measure
from q2r2_control.errors import RobotError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.control.cells import NAMES, CellArrays, arrays_of, cell, distances, placed, random_posture

# Coal computes the distance of two capsules in closed form, and the distance of a capsule and a box by iteration.
EXACT, ITERATED = 1e-9, 1e-4
STEP = 1e-6  # Step of finite differences [rad].


def _coal_distances(robot: Robot, q: Array) -> Array:
    return np.array([pair.distance for pair in robot.distances(q)])


def _core_distance(cell: CellArrays) -> Array:
    """Return for each pair (p,) the distance at which the cores of its bodies meet [m].

    A core is a body without its radius. The closed forms are not smooth below this distance.
    """
    return np.asarray(-cell.bodies.radius[cell.pairs.first] - cell.bodies.radius[cell.pairs.second])


@pytest.mark.parametrize("name", NAMES)
def test_distances_of_all_pairs_equal_coals_distances_outside_and_in_penetration(name: str) -> None:
    arrays, random = cell(name), np.random.default_rng(8)
    postures = np.array([arrays.robot.home, *(random_posture(arrays.robot, random) for _ in range(60))])
    ours = distances(arrays, postures)
    coals = np.array([_coal_distances(arrays.robot, q) for q in postures])
    round_pair = arrays.bodies.box[arrays.pairs.second] == 0
    comparable = ours > _core_distance(arrays) + 1e-3
    for kind, tolerance in ((round_pair, EXACT), (~round_pair, ITERATED)):
        seen = comparable & kind
        assert seen.any()
        np.testing.assert_allclose(ours[seen], coals[seen], rtol=0, atol=tolerance)
    assert (ours[comparable] < 0.0).sum() > 20, "penetrations among them"


@pytest.mark.parametrize("name", NAMES)
def test_the_cheap_lower_bound_is_never_greater_than_the_distance(name: str) -> None:
    arrays, random = cell(name), np.random.default_rng(9)
    for _ in range(20):
        q = random_posture(arrays.robot, random)
        data = placed(arrays, q)
        for p, exact in enumerate(distances(arrays, q[None])[0]):
            assert at_least(arrays.collision, data, p) <= exact + 1e-12


def _row(arrays: CellArrays, data: CollisionData, p: int) -> Array:
    row = np.zeros(arrays.robot.model.nv)
    measure(arrays.collision, data, p)
    distance_row(arrays.collision, data, p, row)
    return row


def _differences(arrays: CellArrays, q: Array, step: float) -> Array:
    """Return central differences (nv, p) of all distances."""
    steps = step * np.eye(len(q))
    return (distances(arrays, q + steps) - distances(arrays, q - steps)) / (2 * step)


def _assert_rows_are_gradients(arrays: CellArrays, q: Array) -> tuple[int, int]:
    """Compare rows with finite differences. Return how many pairs were compared outside and in penetration."""
    here = distances(arrays, q[None])[0]
    slopes, coarse = _differences(arrays, q, STEP), _differences(arrays, q, 10 * STEP)
    data, cores_meet = placed(arrays, q), _core_distance(arrays)
    outside = penetrating = 0
    for p, distance in enumerate(here):
        # Where the closest points jump, there is no gradient, and two step sizes give different results. Such pairs are
        # left out.
        smooth = np.abs(slopes[:, p] - coarse[:, p]).max() < 1e-4
        if distance < cores_meet[p] + 1e-3 or not smooth:
            continue
        np.testing.assert_allclose(_row(arrays, data, p), slopes[:, p], rtol=0, atol=1e-4)
        outside, penetrating = outside + (distance > 0.0), penetrating + (distance <= 0.0)
    return outside, penetrating


@given(seed=st.integers(0, 2**32 - 1), name=st.sampled_from(NAMES))
@settings(derandomize=True, max_examples=40, deadline=None)
def test_rows_are_the_gradients_of_the_distances(seed: int, name: str) -> None:
    arrays = cell(name)
    q = random_posture(arrays.robot, np.random.default_rng(seed))
    outside, penetrating = _assert_rows_are_gradients(arrays, q)
    assert outside + penetrating > 0.5 * len(arrays.pairs.first)


def _way_bound(arrays: CellArrays, way: Array) -> Array:
    """Return for each pair (p,) the bound S [m] of stop_certificate.py if joints travel ``way`` (nv,) [rad or m]."""
    padded = np.concatenate([[0.0], way])
    return np.asarray((arrays.pairs.reach * padded[arrays.pairs.joint]).sum(axis=1))


@given(seed=st.integers(0, 2**32 - 1), name=st.sampled_from(NAMES), size=st.floats(1e-4, 3.0))
@settings(derandomize=True, max_examples=150, deadline=None)
def test_no_distance_changes_by_more_than_the_bound_computed_from_the_travel_of_its_joints(
    seed: int, name: str, size: float
) -> None:
    arrays, random = cell(name), np.random.default_rng(seed)
    q = random_posture(arrays.robot, random)
    other = np.clip(q + random.uniform(-size, size, len(q)), arrays.robot.position_lower, arrays.robot.position_upper)
    here, there = distances(arrays, np.array([q, other]))
    # Pairs whose cores meet are not compared. If a segment enters a box over an edge, the shortest translation out of
    # the box changes its direction suddenly.
    comparable = np.minimum(here, there) > _core_distance(arrays) + 1e-9
    excess = np.abs(here - there) - _way_bound(arrays, np.abs(other - q))
    assert excess[comparable].max() <= 1e-12


SLIDING = """<robot name="slide"><link name="base"><collision><origin xyz="0.9 0 0"/>
<geometry><sphere radius="0.05"/></geometry></collision></link><link name="carriage"/>
<joint name="slide" type="prismatic"><parent link="base"/><child link="carriage"/><axis xyz="1 0 0"/>
<limit lower="-0.5" upper="0.5" velocity="1" effort="1"/></joint>
<link name="turned"/>
<joint name="swing" type="revolute"><parent link="carriage"/><child link="turned"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
<link name="tip"><collision><origin xyz="0.2 0 0"/><geometry><sphere radius="0.05"/></geometry></collision></link>
<joint name="push" type="prismatic"><parent link="turned"/><child link="tip"/><axis xyz="0 1 0"/>
<limit lower="-0.3" upper="0.3" velocity="1" effort="1"/></joint></robot>"""


def test_gradients_and_bounds_on_changes_of_distances_are_right_for_prismatic_joints_too() -> None:
    arrays, random = (
        arrays_of(Robot.from_urdf(SLIDING, {"left": "tip"}, unchecked_links=["carriage", "turned"])),
        np.random.default_rng(13),
    )
    assert arrays.pairs.joint.tolist() == [[1, 2, 3]]
    for _ in range(200):
        q, other = random_posture(arrays.robot, random), random_posture(arrays.robot, random)
        np.testing.assert_allclose(
            _row(arrays, placed(arrays, q), 0), _differences(arrays, q, STEP)[:, 0], rtol=0, atol=1e-6
        )
        here, there = distances(arrays, np.array([q, other]))[:, 0]
        assert abs(here - there) <= _way_bound(arrays, np.abs(other - q))[0] + 1e-12


def test_the_error_about_a_shape_that_no_kernel_can_measure_names_the_shape_and_its_kind() -> None:
    model = pin.GeometryModel()
    model.addGeometryObject(pin.GeometryObject("funnel", 0, pin.SE3.Identity(), coal.Cone(0.1, 0.2)))
    with pytest.raises(RobotError, match=r"funnel.*Cone.*capsule, sphere, box"):
        bodies_of(model)


def test_a_pair_of_two_boxes_is_refused() -> None:
    arrays = cell("dual_iiwa7")
    model = pin.GeometryModel()
    for name in ("crate", "table"):
        model.addGeometryObject(pin.GeometryObject(name, 0, pin.SE3.Identity(), coal.Box(1.0, 1.0, 1.0)))
    model.addCollisionPair(pin.CollisionPair(0, 1))
    with pytest.raises(RobotError, match=r"two boxes; allowed: at most one box"):
        pairs_of(model, arrays.collision.chain, bodies_of(model), np.ones(14), np.ones(2))
