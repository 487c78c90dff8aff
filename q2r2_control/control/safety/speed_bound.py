"""From the present speeds of two bodies, bound how much closer they come in a step and the stop after it (compiled).

The bound S with the reach of joints (stop_certificate.py) treats every joint as if it moved one body straight towards
the other body. For most pairs of two moving arms, a bound from the speeds of the bodies suffices. Joints that stop
together keep the direction of their motion, and arms that move in the same way come no closer at all.

**Speed.** A geometry lies in the ball of radius s around its middle. If the middle moves at u and the link turns at w,
no point of the geometry is faster than |u| + |w| s. The distance of two geometries therefore falls no faster than
|u_2 - u_1| + |w_1| s_1 + |w_2| s_2.

**Claim.** Let two bodies share no joint, and let d be their distance at the reference. Let V = |u_2 - u_1| + |w_1| s_1
+ |w_2| s_2 be the bound on their approach speed there, where the joints have the velocities v. Let a step of h lead to
v+, and a stop with the decelerations d_j and the duration T = max |v+_j| / d_j follow. Then their distance is always at
least

    d  -  V (h + T / 2)  -  sum_j reach_j (rho_j + kappa_j),

    rho_j = |v+_j - v_j| (h + T) / 2  +  |v+_j| T / 2 - v+_j^2 / 2 d_j,
    kappa_j = w_j (w_j / 2 + sum_(i before j) w_i),

where w_j is the travel of joint j in the step and the stop.

*Proof.* Let D_j(t) be how far joint j has moved. Compare it with v_j sigma(t), where sigma = t in the step and sigma =
h + s - s^2 / 2T at the time s of the stop, so that sigma is at most h + T / 2. In the step, |D_j - v_j t| is equal to
|v+_j - v_j| t^2 / 2h <= |v+_j - v_j| h / 2, and this difference stays during the stop. In the stop, v+_j replaces v_j,
which changes v_j (s - s^2 / 2T) by at most |v+_j - v_j| T / 2. The joint itself travels B_j(s) from the step's end.
Since d_j >= |v+_j| / T, the difference |v+_j| (s - s^2 / 2T) - |B_j(s)| is never negative and never falls. At T it is
|v+_j| T / 2 - v+_j^2 / 2 d_j. Together |D_j - v_j sigma| <= rho_j. A point of a body moves by J D + R, with
|R| <= sum reach_j kappa_j over the joints that move it (separating_plane.py says why). Two points, one of each body's
core, therefore get closer by at most |(J_2 - J_1) v| sigma + sum reach_j (rho_j + kappa_j), and |(J_2 - J_1) v| <= V.
The radii cancel. []

If a joint moves both bodies, its velocity is part of V, but the joint is not in the sum. V could then be less than the
speed at which the bodies close in. For that reason the other proofs handle pairs that share a joint.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from q2r2_control.control.geometry.closest_points import size_of, way_between
from q2r2_control.control.geometry.collision import CollisionData, CollisionModel
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.types import Array

if TYPE_CHECKING:
    from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel


class BodyVelocities(NamedTuple):
    """Velocities in world axes, written by :func:`update_body_velocities`."""

    linear: Array  # (n, 3) Velocities of the origins of joint frames [m/s].
    angular: Array  # (n, 3) [rad/s]
    middle: Array  # (g, 3) Velocities of the middles of geometries [m/s].
    swing: Array  # (g,) Greatest speed of a geometry's point relative to the geometry's middle [m/s].

    @classmethod
    def empty(cls, model: CollisionModel) -> BodyVelocities:
        n, g = len(model.chain.parent), len(model.bodies.joint)
        return cls(np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((g, 3)), np.zeros(g))


@kernel
def update_body_velocities(model: CollisionModel, data: CollisionData, v: Array, velocities: BodyVelocities) -> None:
    """Write the velocities of all joint frames and geometries at their placements, for joint velocities ``v`` (nv,)."""
    chain, bodies, placements, posed = model.chain, model.bodies, data.placements, data.posed
    linear, angular = velocities.linear, velocities.angular
    for i in range(1, chain.parent.shape[0]):
        parent, origin = chain.parent[i], placements.translation
        _velocity_at(linear[parent], angular[parent], origin[parent], origin[i], linear[i])
        rate = v[i - 1]
        slides = chain.prismatic[i] == 1
        for k in range(3):
            along = rate * placements.axis[i, k]
            angular[i, k] = angular[parent, k] + (0.0 if slides else along)
            if slides:
                linear[i, k] += along
    for g in range(bodies.joint.shape[0]):
        joint = bodies.joint[g]
        middle = velocities.middle[g]
        for k in range(3):
            middle[k] = 0.5 * (posed.start[g, k] + posed.end[g, k])
        _velocity_at(linear[joint], angular[joint], placements.translation[joint], middle, middle)
        velocities.swing[g] = size_of(angular[joint]) * bodies.size[g]


@kernel
def _velocity_at(linear: Array, angular: Array, origin: Array, point: Array, out: Array) -> None:
    """Write the velocity of ``point`` on a link whose frame is at ``origin``; ``out`` may be ``point`` itself."""
    x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
    out[0] = linear[0] + angular[1] * z - angular[2] * y
    out[1] = linear[1] + angular[2] * x - angular[0] * z
    out[2] = linear[2] + angular[0] * y - angular[1] * x


@kernel
def fastest_body(velocities: BodyVelocities) -> float:
    """Return a bound on the speed of any point of any geometry [m/s]."""
    fastest = 0.0
    for g in range(velocities.swing.shape[0]):
        fastest = max(fastest, speed_of(velocities, g))
    return fastest


@inlined_kernel
def speed_of(velocities: BodyVelocities, g: int) -> float:
    """Return a bound on the speed of any point of geometry ``g`` [m/s]."""
    return size_of(velocities.middle[g]) + velocities.swing[g]


@kernel
def fastest_approach(velocities: BodyVelocities, first: int, second: int) -> float:
    """Return a bound on the speed at which two geometries close in [m/s]."""
    between = way_between(velocities.middle[first], velocities.middle[second])
    return between + velocities.swing[first] + velocities.swing[second]


@kernel
def write_deviations(model: SafetyModel, data: SafetyData, h: float, duration: float) -> float:
    """Write the bound rho + kappa on every joint's deviation from motion at constant velocity [rad or m].

    The bound holds in a step of ``h`` [s] and a stop of ``duration`` [s]. The travel of the joints in both has to be
    written before this call. Returns h + T / 2 [s].
    """
    parent, v, v_next, rollout = model.collision.chain.parent, data.state.v, data.candidate.v, data.rollout
    step, stop = rollout.step.travel, rollout.stop.travel
    for j in range(v.shape[0]):
        rho = 0.5 * abs(v_next[j] - v[j]) * (h + duration) + max(0.5 * abs(v_next[j]) * duration - stop[j], 0.0)
        before = 0.0
        joint = parent[j + 1]
        while joint != 0:
            before += step[joint - 1] + stop[joint - 1]
            joint = parent[joint]
        w = step[j] + stop[j]
        rollout.deviation[j] = rho + w * (0.5 * w + before)
    return h + 0.5 * duration


@inlined_kernel
def least_distance(model: SafetyModel, data: SafetyData, p: int, time: float) -> float:
    """Return a lower bound on the distance of pair ``p``, which shares no joint, in the step and the stop [m].

    Call :func:`write_deviations` before this function. ``data`` has to contain the velocities of the bodies, and the
    distances at the reference or lower bounds of them. ``time`` is h + T / 2 [s].
    """
    pairs = model.collision.pairs
    approach = fastest_approach(data.velocities, pairs.first[p], pairs.second[p])
    return data.distance[p] - approach * time - way(model, p, data.rollout.deviation)


@inlined_kernel
def way(model: SafetyModel, p: int, travel: Array) -> float:
    """Return how far the bodies of pair ``p`` can move relative to each other if each joint moves [m].

    ``travel`` (nv,) is how far each joint travels [rad or m].
    """
    pairs = model.collision.pairs
    total = 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        total += pairs.reach[p, k] * travel[joint - 1]
    return total
