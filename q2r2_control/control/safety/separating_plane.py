"""Proof that two geometries stay apart while the joints move, where their distance alone leaves no room, compiled.

The bound by reach (stop_certificate.py) counts every way a joint travels as if it led straight to the other body. A
pair that rests at min_distance to the micrometre could then never be shown to part again, nor could arms be that carry
a box between them at full speed and close in by nothing. Here the direction counts.

**Claim.** Let n be the unit normal of two convex cores that do not meet, e_1 and e_2 their corners (the ends of a
segment, the corners of a box), J_e the Jacobian of a corner at the start, r the joints' reach. If the joints move by
D(t) with |D_j(t)| <= w_j, then at every t the distance is at least

    min over corners of  n'(e_2 - e_1) + n'(J_e2 - J_e1) D(t)   -   K_1 - K_2   -   radii,

    K = 1/2 sum_k r_k w_k (w_k + 2 sum_(i before k) w_i)   over the joints that move one body relative to the other.

*Proof.* The distance of convex sets is the largest gap between them over all directions, hence at least the gap along
n, which is the least over their corners. Joints that carry both bodies change no distance and count as fixed; each of
the others moves one corner. A corner moves by J_e D and a remainder: its second derivative with respect to joint i and
a later joint k of the same chain is a product of rotations about both axes with the lever of the outer one, at most
r_k, so that Taylor's remainder is at most 1/2 sum_ik r_(the outer one) w_i w_k = K. (A slide has reach 1, and turns
nothing: its second derivative with an inner joint is at most that, with an outer one nothing.) []

In a step, and between two instants of a stop, D_j(t) is a parabola; a joint that comes to rest meanwhile counts as
anywhere between its ends. So what is to be bounded is a parabola for each two corners.
"""

from __future__ import annotations

from typing import NamedTuple

from q2r2_control.control.geometry.collision import (
    BodyPlacements,
    CollisionBodies,
    CollisionData,
    CollisionModel,
    Pairs,
)
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.control.safety.safety_data import QuadraticPiece
from q2r2_control.types import Array


class Gap(NamedTuple):
    """What a corner adds to the gap between the bodies along the normal: now, in a piece, in another one after it."""

    now: float  # [m]
    rate: float  # [m/s]
    change: float  # [m/s^2]
    loose: float  # the least that loose joints add [m]
    then_rate: float
    then_change: float
    then_loose: float


@kernel
def stays_beyond(
    model: CollisionModel, data: CollisionData, p: int, piece: QuadraticPiece, length: float, threshold: float
) -> bool:
    """Whether the plane between pair ``p`` proves it beyond ``threshold`` [m] in a ``piece`` of ``length`` [s].

    The pair has been measured in ``data``, where the piece begins, just before.
    """
    return stay_beyond(model, data, p, piece, length, piece, 0.0, threshold)


@kernel
def stay_beyond(
    model: CollisionModel,
    data: CollisionData,
    p: int,
    piece: QuadraticPiece,
    length: float,
    then: QuadraticPiece,
    then_length: float,
    threshold: float,
) -> bool:
    """As :func:`stays_beyond`, for a ``piece`` and another one after it."""
    pairs, bodies, posed = model.pairs, model.bodies, data.posed
    first, second = pairs.first[p], pairs.second[p]
    needed = threshold + bodies.radius[first] + bodies.radius[second]
    needed += curvature(pairs, p, piece.travel, then.travel, 1.0 if then_length > 0.0 else 0.0)
    start, end = _gaps(model, data, p, -1.0, posed.start[first], posed.end[first], piece, then)
    if bodies.box[second] == 0:
        other_start, other_end = _gaps(model, data, p, 1.0, posed.start[second], posed.end[second], piece, then)
        return _all_open(start, end, other_start, other_end, needed, length, then_length)
    for edge in range(4):
        _write_edge(bodies, posed, second, edge, data.contact.local)
        corner, next_corner = data.contact.local[0], data.contact.local[1]
        other_start, other_end = _gaps(model, data, p, 1.0, corner, next_corner, piece, then)
        if not _all_open(start, end, other_start, other_end, needed, length, then_length):
            return False
    return True


@kernel
def curvature(pairs: Pairs, p: int, travel: Array, then: Array, share: float) -> float:
    """K_1 + K_2 [m] of ways ``travel`` and a ``share`` of ``then``, (nv,) each.

    The joints of a pair are listed from the base outwards.
    """
    total = 0.0
    before_first = 0.0
    before_second = 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        w = travel[joint - 1] + share * then[joint - 1]
        before = before_first if pairs.sign[p, k] < 0.0 else before_second
        total += pairs.reach[p, k] * w * (0.5 * w + before)
        if pairs.sign[p, k] < 0.0:
            before_first += w
        else:
            before_second += w
    return total


@kernel
def _write_edge(bodies: CollisionBodies, posed: BodyPlacements, box: int, number: int, out: Array) -> None:
    """Ends of one of a box's four edges along its third axis, into the first two rows of ``out``."""
    for k in range(3):
        middle = posed.start[box, k]
        for axis in range(2):
            sign = 1.0 if (number >> axis) & 1 else -1.0
            middle += sign * bodies.half[box, axis] * posed.rotation[box, k, axis]
        half = bodies.half[box, 2] * posed.rotation[box, k, 2]
        out[0, k] = middle - half
        out[1, k] = middle + half


@kernel
def _gaps(
    model: CollisionModel,
    data: CollisionData,
    p: int,
    side: float,
    start: Array,
    end: Array,
    piece: QuadraticPiece,
    then: QuadraticPiece,
) -> tuple[Gap, Gap]:
    """What two corners of one side of a pair, -1 the first's or 1 the second's, add to the gap."""
    chain, pairs, placements, normal = model.chain, model.pairs, data.placements, data.contact.normal
    nx, ny, nz = side * normal[0], side * normal[1], side * normal[2]
    gap = nx * start[0] + ny * start[1] + nz * start[2]
    end_gap = nx * end[0] + ny * end[1] + nz * end[2]
    rate, change, loose, then_rate, then_change, then_loose = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    end_rate, end_change, end_loose, end_then_rate, end_then_change, end_then_loose = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        if pairs.sign[p, k] != side:
            continue
        j = joint - 1
        ax, ay, az = placements.axis[joint, 0], placements.axis[joint, 1], placements.axis[joint, 2]
        if chain.prismatic[joint] == 1:
            along = nx * ax + ny * ay + nz * az
            end_along = along
        else:
            # n'(axis x r) = (n x axis)'r, for the levers r of both corners.
            mx, my, mz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
            origin = placements.translation[joint]
            along = mx * (start[0] - origin[0]) + my * (start[1] - origin[1]) + mz * (start[2] - origin[2])
            end_along = mx * (end[0] - origin[0]) + my * (end[1] - origin[1]) + mz * (end[2] - origin[2])
        rate += along * piece.rate[j]
        change += along * piece.change[j]
        loose += min(0.0, along * piece.loose[j])
        then_rate += along * then.rate[j]
        then_change += along * then.change[j]
        then_loose += min(0.0, along * then.loose[j])
        end_rate += end_along * piece.rate[j]
        end_change += end_along * piece.change[j]
        end_loose += min(0.0, end_along * piece.loose[j])
        end_then_rate += end_along * then.rate[j]
        end_then_change += end_along * then.change[j]
        end_then_loose += min(0.0, end_along * then.loose[j])
    return (
        Gap(gap, rate, change, loose, then_rate, then_change, then_loose),
        Gap(end_gap, end_rate, end_change, end_loose, end_then_rate, end_then_change, end_then_loose),
    )


@kernel
def _all_open(
    start: Gap, end: Gap, other_start: Gap, other_end: Gap, needed: float, length: float, then_length: float
) -> bool:
    """Whether all four gaps between corners of one body and of the other stay beyond what is ``needed`` [m]."""
    return (
        _opens(start, other_start, needed, length, then_length)
        and _opens(start, other_end, needed, length, then_length)
        and _opens(end, other_start, needed, length, then_length)
        and _opens(end, other_end, needed, length, then_length)
    )


@inlined_kernel
def _opens(corner: Gap, other: Gap, needed: float, length: float, then_length: float) -> bool:
    """Whether the gap between two corners stays beyond what is ``needed`` [m] in a piece and in the one after it."""
    gap = corner.now + other.now - needed
    rate, change, loose = corner.rate + other.rate, corner.change + other.change, corner.loose + other.loose
    if _least_on_the_way(gap, rate, change, length) + loose < 0.0:
        return False
    if then_length <= 0.0:
        return True
    gap += rate * length + 0.5 * change * length * length + loose
    rate, change = corner.then_rate + other.then_rate, corner.then_change + other.then_change
    least = _least_on_the_way(gap, rate, change, then_length)
    return least + corner.then_loose + other.then_loose >= 0.0


@kernel
def _least_on_the_way(value: float, rate: float, change: float, h: float) -> float:
    """Minimum of value + rate t + change t^2 / 2 over t in [0, h]."""
    least = min(value, value + rate * h + 0.5 * change * h * h)
    if change > 0.0 and 0.0 < -rate < change * h:
        least = min(least, value - rate * rate / (2.0 * change))
    return least
