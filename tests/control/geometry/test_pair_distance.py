from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.geometry.collision import CollisionData, CollisionModel, update_placements
from q2r2_control.control.geometry.pair_distance import (
    _any_normal,
    at_least,
    distance_row,
    measure,
    measure_smooth,
    with_rounded_boxes,
)
from q2r2_control.robot.pairs import pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.control.cells import CellArrays, arrays_of, cell, placed, random_posture

ROBOT, MODEL = cell("dual_iiwa7").robot, cell("dual_iiwa7").collision
NAMES = pair_names(ROBOT.collision_model)
DEPTH = 0.015  # Allowed depth of contacts between fingers and the table [m].
TOUCHING = np.array(["finger" in a + b and "table" in a + b for a, b in NAMES])
ROUNDED = with_rounded_boxes(MODEL, np.where(TOUCHING, DEPTH, -0.02))


def measured(model: CollisionModel, q: Array) -> tuple[Array, Array]:
    """Return every pair's distance (p,) and the lower bound on it (p,) at a posture [m]."""
    data = CollisionData.empty(model)
    update_placements(model, data, q)
    count = len(NAMES)
    bound = np.array([at_least(model, data, p) for p in range(count)])
    return np.array([measure(model, data, p) for p in range(count)]), bound


@pytest.mark.parametrize("seed", range(20))
def test_only_pairs_with_an_allowed_depth_get_rounded_boxes_and_no_rounded_box_is_larger_than_its_box(
    seed: int,
) -> None:
    q = random_posture(ROBOT, np.random.default_rng(seed))
    (distance, _), (rounded, bound) = measured(MODEL, q), measured(ROUNDED, q)
    np.testing.assert_array_equal(rounded[~TOUCHING], distance[~TOUCHING])
    more = (rounded - distance)[TOUCHING]
    # At a corner, rounding removes (sqrt(3) - 1) times the radius. Inside the box, distances may differ by more, since
    # a point deep inside may be nearer to another side of the smaller core.
    assert (more > -1e-9).all()
    outside = distance[TOUCHING] > 0.0
    assert (more[outside] <= (np.sqrt(3.0) - 1.0) * DEPTH + 1e-9).all()
    assert (bound <= rounded + 1e-9).all()


def test_rounded_boxes_do_not_change_distances_above_the_face_of_a_box() -> None:
    (distance, _), (rounded, _) = measured(MODEL, ROBOT.home), measured(ROUNDED, ROBOT.home)
    np.testing.assert_allclose(rounded[TOUCHING], distance[TOUCHING], atol=1e-12)


def test_a_box_is_rounded_with_the_allowed_depth_of_its_pair_as_the_radius() -> None:
    first, second = ((model.bodies.radius[model.pairs.second])[TOUCHING] for model in (MODEL, ROUNDED))
    np.testing.assert_allclose(second - first, DEPTH)


SMOOTHING = 1e-4  # Parameter of the smooth distance [m^2].
CORES_APART = 0.03  # Least distance of the cores in the postures that are compared [m].


def _looked_at(
    arrays: CellArrays, q: Array, p: int, smooth: bool = True, data: CollisionData | None = None
) -> tuple[float, Array]:
    """Return the smooth or the exact distance of pair ``p`` [m], and the row (nv,) that is its gradient.

    If ``data`` of the cell are given, they are overwritten. This is faster, because making new data takes most of the
    time.
    """
    data, row = data or placed(arrays, q), np.zeros(len(q))
    update_placements(arrays.collision, data, q)
    distance = measure_smooth(arrays.collision, data, p, SMOOTHING) if smooth else measure(arrays.collision, data, p)
    distance_row(arrays.collision, data, p, row)
    return distance, row


def _radii(arrays: CellArrays, p: int) -> float:
    return float(arrays.bodies.radius[arrays.pairs.first[p]] + arrays.bodies.radius[arrays.pairs.second[p]])


@pytest.fixture(scope="module")
def seen() -> list[tuple[Array, int]]:
    """Return postures, each with a pair whose cores are apart in this posture. Some of the pairs contain a box."""
    arrays, random = cell("dual_iiwa7"), np.random.default_rng(21)
    found = []
    for _ in range(300):
        q, p = random_posture(arrays.robot, random), int(random.integers(len(arrays.pairs.first)))
        if _looked_at(arrays, q, p, smooth=False)[0] + _radii(arrays, p) > CORES_APART:
            found.append((q, p))
    assert sum(arrays.bodies.box[arrays.pairs.second[p]] for _, p in found) > 10
    return found


def test_the_smooth_distance_exceeds_the_exact_distance_by_at_most_the_stated_bound(
    seen: list[tuple[Array, int]],
) -> None:
    arrays = cell("dual_iiwa7")
    for q, p in seen:
        exact, smooth = _looked_at(arrays, q, p, smooth=False)[0], _looked_at(arrays, q, p)[0]
        assert exact - 1e-12 <= smooth <= exact + SMOOTHING / (4 * (exact + _radii(arrays, p))) + 1e-12


def test_the_row_of_a_smooth_distance_is_its_gradient_for_every_pair(seen: list[tuple[Array, int]]) -> None:
    arrays, data = cell("dual_iiwa7"), placed(cell("dual_iiwa7"), ROBOT.home)
    for q, p in seen:
        row, steps = _looked_at(arrays, q, p, data=data)[1], 1e-6 * np.eye(len(q))
        after, before = (
            np.array([_looked_at(arrays, near, p, data=data)[0] for near in postures])
            for postures in (q + steps, q - steps)
        )
        np.testing.assert_allclose(row, (after - before) / 2e-6, rtol=0, atol=1e-6)


LYING = """<robot name="bars"><link name="base"><collision name="fixed"><origin xyz="0 0 0" rpy="0 {quarter} 0"/>
<geometry>{fixed}</geometry></collision></link>
<link name="beam"/><link name="bar"><collision name="bar_shape"><origin rpy="0 1.5707963267948966 0"/>
<geometry><cylinder radius="0.05" length="0.3"/></geometry></collision>
<collision_checking><capsule name="bar_shape"/></collision_checking></link>
<joint name="tilt" type="revolute"><parent link="base"/><child link="beam"/><origin xyz="0 0 {height}"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
<joint name="roll" type="revolute"><parent link="beam"/><child link="bar"/><axis xyz="1 0 0"/>
<limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""
FIXED = {
    "a bar": (1.5707963267948966, '<cylinder radius="0.05" length="0.3"/>', 0.115),
    "a box": (0.0, '<box size="1 1 0.2"/>', 0.165),
}


@pytest.mark.parametrize("kind", FIXED)
def test_while_a_bar_tilts_over_a_body_the_smooth_row_turns_gradually_and_the_exact_row_jumps(kind: str) -> None:
    quarter, fixed, height = FIXED[kind]
    urdf = LYING.format(quarter=quarter, fixed=fixed, height=height)
    arrays = arrays_of(Robot.from_urdf(urdf, {"left": "bar"}, unchecked_links=["beam"]))
    assert len(arrays.pairs.first) == 1
    tilts = np.linspace(-0.01, 0.01, 401)
    smooth, exact = (
        np.array([_looked_at(arrays, np.array([tilt, 0.0]), 0, kind)[1][0] for tilt in tilts]) for kind in (True, False)
    )
    assert np.abs(np.diff(exact)).max() > 0.1, "from one end to the other"
    assert np.abs(np.diff(smooth)).max() < 0.02
    np.testing.assert_allclose(smooth[[0, -1]], exact[[0, -1]], atol=0.02)


def test_the_normal_of_two_segments_that_touch_is_perpendicular_to_both_segments() -> None:
    random = np.random.default_rng(17)
    for _ in range(50):
        meeting, one, other = random.normal(size=(3, 3))
        normal = np.zeros(3)
        _any_normal(meeting - one, meeting + one, meeting - other, meeting + other, normal)
        np.testing.assert_allclose([normal @ one, normal @ other, normal @ normal], [0.0, 0.0, 1.0], atol=1e-12)
