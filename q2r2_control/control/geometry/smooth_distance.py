"""Distances whose gradient never jumps, for forces that follow the gradient, compiled.

The closest points of two parallel segments, or of a segment along a box's face, jump from end to end as the bodies
tilt: the distance is continuous, its gradient is not, and a force along it would switch at every tick. Here the
parameters s, t in [0, 1] of the closest points are drawn to the segments' middles by a small cost,

    D^2 = min |a(s) - b(t)|^2 + e ((s - 1/2)^2 + (t - 1/2)^2),

which makes them unique and continuous in the posture. By the envelope theorem dD = (b - a)' d(b - a) / D at the points
found, so the usual row of the pair with the normal (b - a) / D, slightly shorter than one, is exactly the gradient
of D. D is larger than the distance d of the cores, by e / (4 d) at most.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp
from q2r2_control.control.geometry.collision import BodyPlacements, CollisionData, CollisionModel, Contact
from q2r2_control.control.jit import kernel
from q2r2_control.types import Array

_HALVINGS = 40


@kernel
def measure_smooth(model: CollisionModel, data: CollisionData, p: int, smoothing: float) -> float:
    """Smooth signed distance [m] of pair ``p``, whose cores are apart; fills ``data.contact`` for the row.

    ``smoothing`` is e [m^2].
    """
    bodies, posed, contact = model.bodies, data.posed, data.contact
    first, second = model.pairs.first[p], model.pairs.second[p]
    start, end = posed.start[first], posed.end[first]
    if bodies.box[second] == 1:
        core = _segment_box(start, end, posed, bodies.half[second], second, smoothing, contact)
    else:
        core = _segment_segment(start, end, posed.start[second], posed.end[second], smoothing, contact)
    for k in range(3):
        contact.normal[k] = (contact.second[k] - contact.first[k]) / core
    return core - bodies.radius[first] - bodies.radius[second]


@kernel
def _segment_segment(a0: Array, a1: Array, b0: Array, b1: Array, smoothing: float, contact: Contact) -> float:
    """D of two segments; the quadratic is strictly convex, so no case is degenerate (compare closest_points.py)."""
    aa = smoothing
    bb = smoothing
    ab = 0.0
    ar = -0.5 * smoothing
    br = 0.5 * smoothing
    for k in range(3):
        u = a1[k] - a0[k]
        w = b1[k] - b0[k]
        r = a0[k] - b0[k]
        aa += u * u
        bb += w * w
        ab += u * w
        ar += u * r
        br += w * r
    s = clamp((ab * br - ar * bb) / (aa * bb - ab * ab), 0.0, 1.0)
    t = (ab * s + br) / bb
    if t < 0.0 or t > 1.0:
        t = clamp(t, 0.0, 1.0)
        s = clamp((ab * t - ar) / aa, 0.0, 1.0)
    square = smoothing * ((s - 0.5) ** 2 + (t - 0.5) ** 2)
    for k in range(3):
        contact.first[k] = a0[k] + s * (a1[k] - a0[k])
        contact.second[k] = b0[k] + t * (b1[k] - b0[k])
        square += (contact.first[k] - contact.second[k]) ** 2
    return np.sqrt(square)


@kernel
def _segment_box(
    a0: Array, a1: Array, posed: BodyPlacements, half: Array, box: int, smoothing: float, contact: Contact
) -> float:
    """D of a segment and a box. The slope of D^2 rises strictly with s, so halving finds its zero."""
    axes, centre, local = posed.rotation[box], posed.start[box], contact.local
    for k in range(3):
        local[0, k] = 0.0
        local[1, k] = 0.0
        for row in range(3):
            local[0, k] += axes[row, k] * (a0[row] - centre[row])
            local[1, k] += axes[row, k] * (a1[row] - a0[row])
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        s = 0.5 * (low + high)
        slope = smoothing * (s - 0.5)
        for k in range(3):
            point = local[0, k] + s * local[1, k]
            slope += (point - clamp(point, -half[k], half[k])) * local[1, k]
        if slope > 0.0:
            high = s
        else:
            low = s
    s = 0.5 * (low + high)
    square = smoothing * (s - 0.5) ** 2
    for k in range(3):
        contact.first[k] = a0[k] + s * (a1[k] - a0[k])
        contact.second[k] = centre[k]
    for k in range(3):
        point = local[0, k] + s * local[1, k]
        on_box = clamp(point, -half[k], half[k])
        square += (point - on_box) ** 2
        for row in range(3):
            contact.second[row] += axes[row, k] * on_box
    return np.sqrt(square)
