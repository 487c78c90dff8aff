"""Prove with a plane between two bodies that they stay apart, if a bound from their distance is too weak (compiled).

The bound S with the reach of joints (stop_certificate.py) treats every joint as if it moved one body straight towards
the other body. With that bound alone, a pair that rests at its min_distance could never be proven to move apart again.
The bound of this module therefore takes the direction of motion into account.

**Claim.** Let n be the unit normal of two convex cores that do not meet, and e_1 and e_2 their corners (the ends of a
segment, the corners of a box). Let J_e be the Jacobian of a corner at the start, and r the joints' reach. If the joints
move by D(t) with |D_j(t)| <= w_j, then at every t the distance is at least

    min over corners of  n'(e_2 - e_1) + n'(J_e2 - J_e1) D(t)   -   K_1 - K_2   -   radii,

    K = 1/2 sum_k r_k w_k (w_k + 2 sum_(i before k) w_i)   over the joints that move one body relative to the other.

*Proof.* The distance of convex sets is the largest gap between them over all directions, hence at least the gap along
n. That gap is the least over their corners. Joints that move both bodies alike change no distance and count as fixed.
Each of the other joints moves one of the two bodies. A corner moves by J_e D and a remainder. The second derivative of
its position with respect to joint i and a later joint k of the same chain is a product of rotations about both axes
with the lever about joint k, which is at most r_k. Taylor's remainder is then at most
1/2 sum_ik r_max(i,k) w_i w_k = K. (A sliding joint has reach 1 and turns nothing: its second derivative with an earlier
joint is at most 1, and with a later joint it is 0.) []

In a step, and between two instants of a stop, D_j(t) is a parabola. A joint that comes to rest in between may be
anywhere between its start and its end. For each pair of corners, the bound is therefore the minimum of a parabola.
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
    """What a corner contributes to the gap between the bodies along the normal [m], in two pieces of motion.

    At the time t after the start of the first piece, this contribution has changed by rate t + change t^2 / 2, and in
    addition by ``loose`` or more. Fields whose names begin with ``then_`` say the same about the second piece.
    """

    now: float  # The corner's contribution at the start of the first piece [m].
    rate: float  # [m/s]
    change: float  # [m/s^2]
    loose: float  # Lower bound of the change by joints that come to rest in the piece; 0 or negative [m].
    then_rate: float
    then_change: float
    then_loose: float


@kernel
def stays_beyond(
    model: CollisionModel,
    data: CollisionData,
    p: int,
    piece: QuadraticPiece,
    length: float,
    then: QuadraticPiece,
    then_length: float,
    threshold: float,
) -> bool:
    """Return whether the plane between the bodies of pair ``p`` proves that they stay farther apart than ``threshold``.

    The proof covers a ``piece`` of motion, which takes ``length`` [s], and the piece ``then`` after it, which takes
    ``then_length`` [s], possibly 0. The pair was measured in ``data``, at the start of ``piece``. ``threshold`` is in
    metres.
    """
    pairs, bodies, posed = model.pairs, model.bodies, data.posed
    first, second = pairs.first[p], pairs.second[p]
    needed = threshold + bodies.radius[first] + bodies.radius[second]
    needed += curvature(pairs, p, piece.travel, then.travel, 1.0 if then_length > 0.0 else 0.0)
    start = _gap(model, data, p, -1.0, posed.start[first], piece, then)
    end = _gap(model, data, p, -1.0, posed.end[first], piece, then)
    corner = data.contact.local[0]
    for number in range(8 if bodies.box[second] == 1 else 2):
        _write_corner(bodies, posed, second, number, corner)
        other = _gap(model, data, p, 1.0, corner, piece, then)
        if not _opens(start, other, needed, length, then_length):
            return False
        if not _opens(end, other, needed, length, then_length):
            return False
    return True


@kernel
def curvature(pairs: Pairs, p: int, travel: Array, then: Array, share: float) -> float:
    """Return the remainder K_1 + K_2 of the module's claim [m].

    The travel of the joints is ``travel`` (nv,) plus a ``share`` of ``then`` (nv,) [rad or m].

    The joints of a pair are listed from the base outwards.
    """
    total, before_first, before_second = 0.0, 0.0, 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        w = travel[joint - 1] + share * then[joint - 1]
        if pairs.sign[p, k] < 0.0:
            total += pairs.reach[p, k] * w * (0.5 * w + before_first)
            before_first += w
        else:
            total += pairs.reach[p, k] * w * (0.5 * w + before_second)
            before_second += w
    return total


@inlined_kernel
def _write_corner(bodies: CollisionBodies, posed: BodyPlacements, body: int, number: int, out: Array) -> None:
    """Write one of the two ends of a segment, or of the eight corners of a box, into ``out`` (3,)."""
    for k in range(3):
        out[k] = posed.end[body, k] if number == 0 else posed.start[body, k]
        if bodies.box[body] == 1:
            for axis in range(3):
                sign = 1.0 if (number >> axis) & 1 else -1.0
                out[k] += sign * bodies.half[body, axis] * posed.rotation[body, k, axis]


@inlined_kernel
def _gap(
    model: CollisionModel,
    data: CollisionData,
    p: int,
    side: float,
    corner: Array,
    piece: QuadraticPiece,
    then: QuadraticPiece,
) -> Gap:
    """Return what a ``corner`` (3,) contributes to the gap along the normal, and how this contribution changes.

    The contribution is computed at the start of ``piece``, and its changes during ``piece`` and ``then``; see
    :class:`Gap`. ``side`` is -1 for a corner of the first body, else 1.
    """
    chain, pairs, placements, normal = model.chain, model.pairs, data.placements, data.contact.normal
    nx, ny, nz = side * normal[0], side * normal[1], side * normal[2]
    x, y, z = corner[0], corner[1], corner[2]
    rate, change, loose, then_rate, then_change, then_loose = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
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
        else:
            # The following numbers are n x axis, because n'(axis x r) = (n x axis)'r for the lever r of the corner.
            mx, my, mz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
            origin = placements.translation[joint]
            along = mx * (x - origin[0]) + my * (y - origin[1]) + mz * (z - origin[2])
        rate += along * piece.rate[j]
        change += along * piece.change[j]
        loose += min(0.0, along * piece.loose[j])
        then_rate += along * then.rate[j]
        then_change += along * then.change[j]
        then_loose += min(0.0, along * then.loose[j])
    return Gap(nx * x + ny * y + nz * z, rate, change, loose, then_rate, then_change, then_loose)


@inlined_kernel
def _opens(corner: Gap, other: Gap, needed: float, length: float, then_length: float) -> bool:
    """Return whether the gap between two corners stays above ``needed`` [m] in a piece and in the next piece."""
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
    """Return the minimum of value + rate t + change t^2 / 2 over t in [0, h]."""
    least = min(value, value + rate * h + 0.5 * change * h * h)
    if change > 0.0 and 0.0 < -rate < change * h:
        least = min(least, value - rate * rate / (2.0 * change))
    return least
