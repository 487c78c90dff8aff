"""Compute the closest points and the signed distances of segments and boxes (compiled).

A capsule is the set of points within ``radius`` of a segment. The distance of two capsules is therefore the distance of
their segments minus both radii. A sphere is a capsule whose segment is a point. The radii only shift the distance.
The distance therefore stays exact when capsules penetrate each other, and its gradient stays smooth, until the segments
themselves meet.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.types import Array

_TINY = 1e-12


@inlined_kernel
def dot(a: Array, b: Array) -> float:
    """Return the scalar product of two vectors."""
    total = 0.0
    for k in range(a.shape[0]):
        total += a[k] * b[k]
    return total


@inlined_kernel
def size_of(a: Array) -> float:
    """Return the Euclidean norm of a vector."""
    return np.sqrt(dot(a, a))


@inlined_kernel
def way_between(a: Array, b: Array) -> float:
    """Return the Euclidean distance of two points."""
    square = 0.0
    for k in range(a.shape[0]):
        square += (a[k] - b[k]) ** 2
    return np.sqrt(square)


@kernel
def clamp(value: float, lower: float, upper: float) -> float:
    """Return the number in ``[lower, upper]`` that is nearest to ``value``."""
    return min(max(value, lower), upper)


@kernel
def segment_segment(a0: Array, a1: Array, b0: Array, b1: Array, on_a: Array, on_b: Array) -> float:
    """Return the distance [m] of segments a0-a1 and b0-b1, each (3,). The closest points are written too.

    The kernel minimises the convex quadratic |a(s) - b(t)|^2 over the unit square. It takes s at the unconstrained
    minimum, then the best t for this s, then the best s again if t was clamped (Ericson, Real-Time Collision Detection,
    2005, section 5.1.9). The closest points are written into ``on_a`` and ``on_b`` (3,).
    """
    aa, bb, ab, ar, br = products(a0, a1, b0, b1)
    s, t = 0.0, 0.0
    if aa > _TINY and bb > _TINY:
        determinant = aa * bb - ab * ab
        # Parallel segments have many pairs of closest points. The middle of the overlap changes least if the segments
        # tilt. The distance there is too large by at most half the overlap times the angle. Therefore only segments
        # with an angle below 1e-7 rad count as parallel.
        if determinant > 1e-14 * aa * bb:
            s = clamp((ab * br - ar * bb) / determinant, 0.0, 1.0)
        else:
            s = _middle_of_overlap(aa, ab, ar)
        t = (ab * s + br) / bb
        if t < 0.0:
            t = 0.0
            s = clamp(-ar / aa, 0.0, 1.0)
        elif t > 1.0:
            t = 1.0
            s = clamp((ab - ar) / aa, 0.0, 1.0)
    elif aa > _TINY:
        s = clamp(-ar / aa, 0.0, 1.0)
    elif bb > _TINY:
        t = clamp(br / bb, 0.0, 1.0)
    for k in range(3):
        on_a[k] = a0[k] + s * (a1[k] - a0[k])
        on_b[k] = b0[k] + t * (b1[k] - b0[k])
    return way_between(on_a, on_b)


@kernel
def products(a0: Array, a1: Array, b0: Array, b1: Array) -> tuple[float, float, float, float, float]:
    """Return the scalar products u'u, w'w, u'w, u'r and w'r of u = a1 - a0, w = b1 - b0 and r = a0 - b0."""
    aa, bb, ab, ar, br = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        u, w, r = a1[k] - a0[k], b1[k] - b0[k], a0[k] - b0[k]
        aa += u * u
        bb += w * w
        ab += u * w
        ar += u * r
        br += w * r
    return aa, bb, ab, ar, br


@kernel
def _middle_of_overlap(aa: float, ab: float, ar: float) -> float:
    """Return the parameter of a point on segment a: the middle of the part of a that the parallel segment b covers."""
    start, end = -ar / aa, (ab - ar) / aa  # Parameters on a of the ends of b, projected onto a.
    return 0.5 * (clamp(start, 0.0, 1.0) + clamp(end, 0.0, 1.0))


@kernel
def segment_box(a0: Array, a1: Array, half: Array, on_a: Array, on_box: Array, normal: Array) -> float:
    """Return the signed distance [m] of a segment and a box of half sides ``half`` (3,), in the frame of the box.

    The closest points and the unit normal from the segment to the box are written. The squared distance along the
    segment is convex and piecewise quadratic. Its pieces meet at the parameters, six at most, at which the segment
    crosses the plane of a face. Between two such parameters, the zero of the slope is found exactly. If the segment
    enters the box, the distance is minus the length of the shortest translation that moves it out of the box.
    """
    s = _minimum_along(a0, a1, half)
    for k in range(3):
        on_a[k] = a0[k] + s * (a1[k] - a0[k])
        on_box[k] = clamp(on_a[k], -half[k], half[k])
    distance = way_between(on_a, on_box)
    if distance > 1e-9:
        for k in range(3):
            normal[k] = (on_box[k] - on_a[k]) / distance
        return distance
    return _push_out(a0, a1, half, on_a, on_box, normal)


@kernel
def _slope_along(a0: Array, a1: Array, half: Array, s: float) -> float:
    """Return half the derivative of the squared distance with respect to the parameter, at the parameter ``s``."""
    slope = 0.0
    for k in range(3):
        direction = a1[k] - a0[k]
        point = a0[k] + s * direction
        slope += (point - clamp(point, -half[k], half[k])) * direction
    return slope


@kernel
def _minimum_along(a0: Array, a1: Array, half: Array) -> float:
    """Return the parameter s at which the distance is least; the middle if it is least on an interval.

    It is least on an interval if the segment runs along a face. A crossing is a parameter at which the segment crosses
    the plane of a face. The slope never falls with s. The largest crossing with a negative slope and the smallest
    crossing with a positive slope therefore enclose all minima. At every crossing between these two, the slope is zero.
    """
    low, low_slope = 0.0, _slope_along(a0, a1, half, 0.0)
    high, high_slope = 1.0, _slope_along(a0, a1, half, 1.0)
    if low_slope > _TINY:
        return 0.0
    if high_slope < -_TINY:
        return 1.0
    first_flat = 0.0 if low_slope >= -_TINY else np.inf
    last_flat = 1.0 if high_slope <= _TINY else -np.inf
    for k in range(3):
        direction = a1[k] - a0[k]
        if abs(direction) <= _TINY:
            continue
        for face in (-half[k], half[k]):
            s = (face - a0[k]) / direction
            if not 0.0 < s < 1.0:
                continue
            slope = _slope_along(a0, a1, half, s)
            if slope < -_TINY:
                if s > low:
                    low, low_slope = s, slope
            elif slope > _TINY:
                if s < high:
                    high, high_slope = s, slope
            else:
                first_flat = min(first_flat, s)
                last_flat = max(last_flat, s)
    if first_flat <= last_flat:
        return 0.5 * (first_flat + last_flat)
    if first_flat < np.inf:
        return first_flat
    if last_flat > -np.inf:
        return last_flat
    return low - low_slope * (high - low) / (high_slope - low_slope)


@kernel
def _push_out(a0: Array, a1: Array, half: Array, on_a: Array, on_box: Array, normal: Array) -> float:
    """Return minus the depth of a segment that enters the box [m]; the closest points and the normal are written.

    The depth is the length of the shortest translation that takes the segment out of the box. The translation leads to
    the nearest face of the Minkowski difference of both (Cameron, ICRA 1997). Such a face comes from a face of the box,
    or from an edge of the box together with the segment. Without the faces from edges, the depth would jump when a
    segment begins to cut an edge.
    """
    best, axis, sign, edge = np.inf, 0, 1.0, -1
    least = 1e-6 * way_between(a0, a1)
    for k in range(3):
        for side in (1.0, -1.0):
            depth = half[k] - min(side * a0[k], side * a1[k])
            if depth < best:
                best, axis, sign = depth, k, side
    for k in range(3):
        depth = _depth_across(a0, a1, half, k, least, normal)
        if depth < best:
            best, edge = depth, k
    if edge >= 0:
        _depth_across(a0, a1, half, edge, least, normal)
        _across_edge(a0, a1, half, edge, on_a, on_box, normal)
        return -best
    deeper_is_a0 = sign * a0[axis] < sign * a1[axis]
    for k in range(3):
        on_a[k] = a0[k] if deeper_is_a0 else a1[k]
        normal[k] = 0.0
        on_box[k] = on_a[k]
    on_box[axis] = sign * half[axis]
    normal[axis] = -sign  # The normal points from the segment into the box, against the translation.
    return -best


@kernel
def _depth_across(a0: Array, a1: Array, half: Array, k: int, least: float, normal: Array) -> float:
    """Return how far the segment has to move to leave the box across an edge that is parallel to the axis ``k`` [m].

    The result is infinite if the segment itself is parallel to this axis. ``normal`` is written. It points from the
    segment into the box.
    """
    i, j = (k + 1) % 3, (k + 2) % 3
    # The translation is along the cross product e_k x (a1 - a0).
    x, y = a0[j] - a1[j], a1[i] - a0[i]
    size = np.sqrt(x * x + y * y)
    if size <= least:
        return np.inf
    x, y = x / size, y / size
    along = x * a0[i] + y * a0[j]
    out = 1.0 if along >= 0.0 else -1.0
    normal[k], normal[i], normal[j] = 0.0, -out * x, -out * y
    return half[i] * abs(x) + half[j] * abs(y) - abs(along)


@kernel
def _across_edge(a0: Array, a1: Array, half: Array, k: int, on_a: Array, on_box: Array, normal: Array) -> None:
    """Write the closest points of the segment and of the edge across which the segment leaves the box.

    The segment moves against ``normal``. The edge is parallel to the axis ``k``.
    """
    i, j = (k + 1) % 3, (k + 2) % 3
    for axis in (i, j):
        on_box[axis] = -half[axis] if normal[axis] > 0.0 else half[axis]
    # Seen along the edge, the segment is a line. The foot of the perpendicular is its point nearest to the edge.
    x, y = a1[i] - a0[i], a1[j] - a0[j]
    s = clamp(((on_box[i] - a0[i]) * x + (on_box[j] - a0[j]) * y) / (x * x + y * y), 0.0, 1.0)
    for axis in range(3):
        on_a[axis] = a0[axis] + s * (a1[axis] - a0[axis])
    on_box[k] = clamp(on_a[k], -half[k], half[k])
