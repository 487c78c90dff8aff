from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from q2r2_control.control.geometry.closest_points import segment_box, segment_segment
from q2r2_control.types import Array

SAMPLES = 300


class Segments(NamedTuple):
    a0: Array
    a1: Array
    b0: Array
    b1: Array


def _segments(kind: str, random: np.random.Generator) -> Segments:
    a0, a1, b0, b1 = random.uniform(-1, 1, (4, 3))
    s, t = random.uniform(0.1, 0.9, 2)
    parallel = b0 + random.uniform(-2, 2) * (a1 - a0)
    ends = {
        "apart": (a0, a1, b0, b1),
        "parallel": (a0, a1, b0, parallel),
        "nearly parallel": (a0, a1, b0, parallel + 10.0 ** random.uniform(-10, -3) * random.normal(size=3)),
        "on one line": tuple(a0 + share * a1 for share in random.uniform(-1, 1, 4)),
        "crossing": (a0 - s * a1, a0 + (1 - s) * a1, a0 - t * b1, a0 + (1 - t) * b1),
        "a point and a segment": (a0, a0.copy(), b0, b1),
        "two points": (a0, a0.copy(), b0, b0.copy()),
        "sharing an end": (a0, a1, a0.copy(), b1),
    }
    return Segments(*ends[kind])


KINDS = (
    *("apart", "parallel", "nearly parallel", "on one line"),
    *("crossing", "a point and a segment", "two points", "sharing an end"),
)


def _to_segment(point: Array, start: Array, end: Array) -> float:
    along = end - start
    square = float(along @ along)
    share = np.clip((point - start) @ along / square, 0.0, 1.0) if square > 0.0 else 0.0
    return float(np.linalg.norm(point - start - share * along))


def _least_distance(segments: Segments) -> float:
    """Return the least distance of two segments. The method differs from the kernel's method.

    The squared distance is a convex quadratic function of (s, t). On the unit square, it is least at its unconstrained
    minimum if this minimum lies inside, otherwise on a side.
    """
    a0, a1, b0, b1 = segments
    candidates = [_to_segment(a0, b0, b1), _to_segment(a1, b0, b1), _to_segment(b0, a0, a1), _to_segment(b1, a0, a1)]
    directions = np.column_stack([a1 - a0, b0 - b1])
    s, t = np.linalg.lstsq(directions, b0 - a0, rcond=1e-12)[0]
    if 0.0 <= s <= 1.0 and 0.0 <= t <= 1.0:
        candidates.append(float(np.linalg.norm(directions @ [s, t] - (b0 - a0))))
    return min(candidates)


@pytest.mark.parametrize("kind", KINDS)
def test_the_distance_of_two_segments_equals_the_distance_of_their_closest_points(kind: str) -> None:
    random = np.random.default_rng(1)
    on_a, on_b = np.zeros(3), np.zeros(3)
    # Segments that are parallel except for rounding are measured in the middle of the overlap, not at its nearer end.
    # The tolerance for them is therefore greater.
    tolerance = 1e-7 if kind == "nearly parallel" else 1e-9
    for _ in range(SAMPLES):
        segments = _segments(kind, random)
        distance = segment_segment(*segments, on_a, on_b)
        assert distance == pytest.approx(_least_distance(segments), abs=tolerance)
        assert distance == pytest.approx(np.linalg.norm(on_a - on_b), abs=1e-12)
        assert _to_segment(on_a, segments.a0, segments.a1) < 1e-9
        assert _to_segment(on_b, segments.b0, segments.b1) < 1e-9
        swapped = segment_segment(segments.b0, segments.b1, segments.a0, segments.a1, on_b, on_a)
        assert swapped == pytest.approx(distance, abs=tolerance)


class BoxAnswer(NamedTuple):
    distance: float
    on_a: Array
    on_box: Array
    normal: Array


def _to_box(a0: npt.ArrayLike, a1: npt.ArrayLike, half: Array) -> BoxAnswer:
    on_a, on_box, normal = np.zeros(3), np.zeros(3), np.zeros(3)
    distance = segment_box(np.asarray(a0, dtype=float), np.asarray(a1, dtype=float), half, on_a, on_box, normal)
    return BoxAnswer(distance, on_a, on_box, normal)


def _outside(points: Array, half: Array) -> Array:
    """Return the distance of points (..., 3) from a box; 0 inside."""
    return np.asarray(np.linalg.norm(points - np.clip(points, -half, half), axis=-1))


def _nearest_along(a0: Array, a1: Array, half: Array) -> Array:
    """Return the distance of each segment from its box (n,). All arguments are (n, 3).

    The distance of a point from the box is convex along the segment, so bisection finds its minimum.
    """
    low, high = np.zeros((len(a0), 1)), np.ones((len(a0), 1))
    for _ in range(100):
        middle = 0.5 * (low + high)
        point = a0 + middle * (a1 - a0)
        falls = ((point - np.clip(point, -half, half)) * (a1 - a0)).sum(axis=1, keepdims=True) <= 0.0
        low, high = np.where(falls, middle, low), np.where(falls, high, middle)
    ends = [_outside(a0 + share * (a1 - a0), half) for share in (0.0, low, high, 1.0)]
    return np.asarray(np.min(ends, axis=0))


def _boxes_and_segments(count: int, spread: float = 1.0) -> Iterator[tuple[Array, Array, Array, float]]:
    """Yield the ends of segments, half the sizes of boxes, and the distance of each segment from its box."""
    random = np.random.default_rng(2)
    half = np.empty((count, 3))
    ends = np.empty((count, 2, 3))
    for i in range(count):
        half[i], ends[i] = random.uniform(0.02, 0.5, 3), random.uniform(-spread, spread, (2, 3))
    a0, a1 = ends[:, 0], ends[:, 1]
    yield from zip(a0, a1, half, _nearest_along(a0, a1, half).tolist(), strict=True)


def test_the_distance_of_a_segment_outside_a_box_equals_the_distance_of_its_nearest_point() -> None:
    outside = 0
    for a0, a1, half, expected in _boxes_and_segments(1000):
        if expected < 1e-6:
            continue
        outside += 1
        answer = _to_box(a0, a1, half)
        assert answer.distance == pytest.approx(expected, abs=1e-9)
        _assert_witnesses(answer, a0, a1, half)
    assert outside > 500


def _assert_witnesses(answer: BoxAnswer, a0: Array, a1: Array, half: Array) -> None:
    assert _to_segment(answer.on_a, a0, a1) < 1e-9
    assert _outside(answer.on_box, half) < 1e-9
    assert np.linalg.norm(answer.normal) == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(answer.on_box - answer.on_a, answer.distance * answer.normal, atol=1e-9)


SPECIAL = {
    "along a face": ([-0.1, 0.0, 0.5], [0.3, 0.1, 0.5], 0.2),
    "along an edge": ([0.6, -0.1, 0.7], [0.6, 0.1, 0.7], np.hypot(0.2, 0.4)),
    "upright above a face": ([0.1, 0.0, 0.4], [0.1, 0.0, 0.9], 0.1),
    "pointing at a corner": ([0.6, 0.4, 0.5], [1.2, 0.8, 1.0], np.sqrt(0.12)),
    "touching a face from outside": ([0.0, 0.0, 0.3], [0.0, 0.0, 0.8], 0.0),
    "lying on a face": ([-0.1, 0.0, 0.3], [0.1, 0.0, 0.3], 0.0),
    "ending at a corner": ([0.4, 0.2, 0.3], [0.9, 0.9, 0.9], 0.0),
    "a point inside": ([0.0, 0.1, 0.0], [0.0, 0.1, 0.0], -0.1),
    "wholly inside": ([-0.1, 0.0, 0.2], [0.1, 0.0, 0.2], -0.1),
    "dipping into the top": ([0.0, 0.0, 0.25], [0.0, 0.0, 0.9], -0.05),
}


@pytest.mark.parametrize(("a0", "a1", "expected"), SPECIAL.values(), ids=SPECIAL.keys())
def test_the_distance_of_a_segment_and_a_box_is_right_in_special_positions(
    a0: list[float], a1: list[float], expected: float
) -> None:
    half = np.array([0.4, 0.2, 0.3])
    for start, end in ((a0, a1), (a1, a0)):
        answer = _to_box(np.array(start), np.array(end), half)
        assert answer.distance == pytest.approx(expected, abs=1e-9)
        _assert_witnesses(answer, np.array(start), np.array(end), half)


def test_the_depth_of_a_segment_in_a_box_is_the_length_of_the_shortest_translation_out_of_the_box() -> None:
    directions = np.random.default_rng(8).normal(size=(400, 3))
    directions = np.vstack([directions / np.linalg.norm(directions, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    entered = across = 0
    for a0, a1, half, nearest in _boxes_and_segments(1000, spread=0.4):
        if nearest > 1e-9:
            continue
        entered += 1
        answer = _to_box(a0, a1, half)
        assert answer.distance <= 0.0
        assert _to_segment(answer.on_a, a0, a1) < 1e-9
        np.testing.assert_allclose(answer.on_box - answer.on_a, answer.distance * answer.normal, atol=1e-9)
        assert np.abs(np.abs(answer.on_box) - half).min() < 1e-9, "the way out ends on the box"
        across += np.abs(answer.normal).max() < 1.0 - 1e-9
        # A segment that moves along a direction is outside when its rear end has passed the farthest corner of the box.
        ways = np.abs(directions) @ half - np.minimum(directions @ a0, directions @ a1)
        assert -answer.distance <= ways.min() + 1e-9
        out = answer.distance * answer.normal
        assert _to_box(a0 + 1.0001 * out, a1 + 1.0001 * out, half).distance >= 0.0
    assert entered > 200
    assert across > 20
