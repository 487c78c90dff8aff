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

from q2r2_control.control.geometry.collision import Bodies, CollisionData, CollisionModel, Pairs, Posed
from q2r2_control.control.jit import lean_kernel
from q2r2_control.control.safety.safety_data import Piece
from q2r2_control.types import Array


@lean_kernel
def stays_beyond(
    model: CollisionModel, data: CollisionData, p: int, piece: Piece, length: float, threshold: float
) -> bool:
    """Whether the plane between pair ``p`` proves it beyond ``threshold`` [m] in a ``piece`` of ``length`` [s].

    The pair has been measured in ``data``, where the piece begins, just before.
    """
    return stay_beyond(model, data, p, piece, length, piece, 0.0, threshold)


@lean_kernel
def stay_beyond(
    model: CollisionModel,
    data: CollisionData,
    p: int,
    piece: Piece,
    length: float,
    then: Piece,
    then_length: float,
    threshold: float,
) -> bool:
    """As :func:`stays_beyond`, for a ``piece`` and another one after it."""
    pairs, bodies, contact = model.pairs, model.bodies, data.contact
    first, second = pairs.first[p], pairs.second[p]
    needed = threshold + bodies.radius[first] + bodies.radius[second]
    needed += curvature(pairs, p, piece.travel, then.travel, 1.0 if then_length > 0.0 else 0.0)
    corner = contact.witness
    for i in range(2):
        _corner(bodies, data.posed, first, i, corner)
        first_gap = _gap(model, data, p, -1.0, piece, then)
        for j in range(8 if bodies.box[second] == 1 else 2):
            _corner(bodies, data.posed, second, j, corner)
            second_gap = _gap(model, data, p, 1.0, piece, then)
            gap = first_gap[0] + second_gap[0] - needed
            rate, change, loose = (
                first_gap[1] + second_gap[1],
                first_gap[2] + second_gap[2],
                first_gap[3] + second_gap[3],
            )
            if _least_on_the_way(gap, rate, change, length) + loose < 0.0:
                return False
            if then_length > 0.0:
                gap += rate * length + 0.5 * change * length * length + loose
                rate, change = first_gap[4] + second_gap[4], first_gap[5] + second_gap[5]
                loose = first_gap[6] + second_gap[6]
                if _least_on_the_way(gap, rate, change, then_length) + loose < 0.0:
                    return False
    return True


@lean_kernel
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


@lean_kernel
def _corner(bodies: Bodies, posed: Posed, body: int, number: int, out: Array) -> None:
    for k in range(3):
        out[k] = posed.start[body, k] if number == 0 else posed.end[body, k]
        if bodies.box[body] == 1:
            out[k] = posed.start[body, k]
            for axis in range(3):
                sign = 1.0 if (number >> axis) & 1 else -1.0
                out[k] += sign * bodies.half[body, axis] * posed.rotation[body, k, axis]


@lean_kernel
def _gap(
    model: CollisionModel, data: CollisionData, p: int, side: float, piece: Piece, then: Piece
) -> tuple[float, float, float, float, float, float, float]:
    """What one side of a pair, -1 the first's or 1 the second's, adds to the gap at a corner, the ``witness``.

    Returns the gap itself [m], and for each piece its rate [m/s], the rate's change [m/s^2], and the least that loose
    joints add [m].
    """
    chain, pairs, placements = model.chain, model.pairs, data.placements
    point, normal = data.contact.witness, data.contact.normal
    gap = side * (normal[0] * point[0] + normal[1] * point[1] + normal[2] * point[2])
    rate, change, loose = 0.0, 0.0, 0.0
    then_rate, then_change, then_loose = 0.0, 0.0, 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        if pairs.sign[p, k] != side:
            continue
        ax, ay, az = placements.axis[joint, 0], placements.axis[joint, 1], placements.axis[joint, 2]
        if chain.prismatic[joint] == 1:
            along = normal[0] * ax + normal[1] * ay + normal[2] * az
        else:
            x = point[0] - placements.translation[joint, 0]
            y = point[1] - placements.translation[joint, 1]
            z = point[2] - placements.translation[joint, 2]
            along = normal[0] * (ay * z - az * y) + normal[1] * (az * x - ax * z) + normal[2] * (ax * y - ay * x)
        along *= side
        rate += along * piece.rate[joint - 1]
        change += along * piece.change[joint - 1]
        loose += min(0.0, along * piece.loose[joint - 1])
        then_rate += along * then.rate[joint - 1]
        then_change += along * then.change[joint - 1]
        then_loose += min(0.0, along * then.loose[joint - 1])
    return gap, rate, change, loose, then_rate, then_change, then_loose


@lean_kernel
def _least_on_the_way(value: float, rate: float, change: float, h: float) -> float:
    """Minimum of value + rate t + change t^2 / 2 over t in [0, h]."""
    least = min(value, value + rate * h + 0.5 * change * h * h)
    if change > 0.0 and 0.0 < -rate < change * h:
        least = min(least, value - rate * rate / (2.0 * change))
    return least
