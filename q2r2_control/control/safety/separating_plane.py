"""Proof that a step keeps two geometries apart where their distance alone leaves no room for one, compiled.

The bound by reach (stop_certificate.py) counts every way a joint travels as if it led straight to the other body. A
pair that rests at min_distance to the micrometre could then never be shown to part again. Here the direction counts.

**Claim.** Let n be the unit normal of two convex cores that do not meet, e_1 and e_2 their corners (the ends of a
segment, the corners of a box), J_e the Jacobian of a corner at the start, r the joints' reach. If the joints move by
D(t) with |D_j(t)| <= w_j, then at every t the distance is at least

    min over corners of  n'(e_2 - e_1) + n'(J_e2 - J_e1) D(t)   -   1/2 (sum_j w_j) (sum_j r_j w_j)   -   radii.

*Proof.* The distance of convex sets is the largest gap between them over all directions, hence at least the gap along
n, which is the least over their corners. Joints that carry both bodies change no distance and count as fixed; each of
the others moves one corner. A corner moves by J_e D and a remainder: its second derivative with respect to joints i and
j is a product of rotations about both axes with the lever of the outer one, at most r_j, so that Taylor's remainder is
at most 1/2 sum_ij r_j w_i w_j. []

In a step D(t) = v t + (v+ - v) t^2 / (2 h), so what is to be bounded is a parabola for each two corners.
"""

from __future__ import annotations

from q2r2_control.control.geometry.collision import Bodies, CollisionData, CollisionModel, Posed
from q2r2_control.control.jit import lean_kernel
from q2r2_control.control.safety.safety_data import SafetyData
from q2r2_control.control.safety.safety_model import SafetyModel
from q2r2_control.types import Array


@lean_kernel
def step_keeps_beyond(model: SafetyModel, data: SafetyData, p: int, h: float, threshold: float) -> bool:
    """Whether the plane between pair ``p`` proves it beyond ``threshold`` [m] in a step ``h`` to the candidate.

    The pair has been measured at the reference just before; ``data.rollout.step_travel`` bounds how far each joint
    gets from there.
    """
    pairs, bodies, contact = model.collision.pairs, model.collision.bodies, data.collision.contact
    first, second = pairs.first[p], pairs.second[p]
    travel = data.rollout.step_travel
    total = 0.0
    levered = 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        total += travel[joint - 1]
        levered += pairs.reach[p, k] * travel[joint - 1]
    needed = threshold + bodies.radius[first] + bodies.radius[second] + 0.5 * total * levered
    corner = contact.witness
    for i in range(2):
        for j in range(8 if bodies.box[second] == 1 else 2):
            gap = 0.0
            rate = 0.0
            change = 0.0
            for side in range(2):
                _corner(bodies, data.collision.posed, second if side == 1 else first, j if side == 1 else i, corner)
                sign = 1.0 if side == 1 else -1.0
                for k in range(3):
                    gap += sign * contact.normal[k] * corner[k]
                rate += _corner_rate(model.collision, data.collision, p, sign, data.state.v)
                change += _corner_rate(model.collision, data.collision, p, sign, data.candidate.v)
            if _least_on_the_way(gap, rate, (change - rate) / h, h) < needed:
                return False
    return True


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
def _corner_rate(model: CollisionModel, data: CollisionData, p: int, side: float, v: Array) -> float:
    """What joints on one side of a pair, -1 the first's or 1 the second's, add to the gap's rate at the corner [m/s].

    The corner is the contact's ``witness``.
    """
    chain, pairs, placements = model.chain, model.pairs, data.placements
    point, normal = data.contact.witness, data.contact.normal
    rate = 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        if pairs.sign[p, k] != side:
            continue
        ax, ay, az = placements.axis[joint, 0], placements.axis[joint, 1], placements.axis[joint, 2]
        if chain.prismatic[joint] == 1:
            rate += side * v[joint - 1] * (normal[0] * ax + normal[1] * ay + normal[2] * az)
            continue
        x = point[0] - placements.translation[joint, 0]
        y = point[1] - placements.translation[joint, 1]
        z = point[2] - placements.translation[joint, 2]
        along = normal[0] * (ay * z - az * y) + normal[1] * (az * x - ax * z) + normal[2] * (ax * y - ay * x)
        rate += side * v[joint - 1] * along
    return rate


@lean_kernel
def _least_on_the_way(value: float, rate: float, change: float, h: float) -> float:
    """Minimum of value + rate t + change t^2 / 2 over t in [0, h]."""
    least = min(value, value + rate * h + 0.5 * change * h * h)
    if change > 0.0 and 0.0 < -rate < change * h:
        least = min(least, value - rate * rate / (2.0 * change))
    return least
