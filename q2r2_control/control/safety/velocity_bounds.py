"""How fast geometries move, and with that how fast two of them can close in at most, compiled.

A geometry lies in the ball of radius s around its middle. With the middle moving at u and the link turning at w, no
point of it is faster than |u| + |w| s, so the distance of two geometries falls no faster than

    |u_2 - u_1| + |w_1| s_1 + |w_2| s_2.

The certificate relies on this bound (speed_bound.py). Arms that move alike do not close in at all, however fast they
are; the bound by reach (stop_certificate.py) cannot see that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.collision import CollisionData, CollisionModel
from q2r2_control.control.jit import kernel
from q2r2_control.types import Array


class BodyVelocities(NamedTuple):
    """Velocities in world axes, written by :func:`update_body_velocities`."""

    linear: Array  # (n, 3) of joint frames' origins [m/s]
    angular: Array  # (n, 3) [rad/s]
    middle: Array  # (g, 3) of geometries' middles [m/s]
    swing: Array  # (g,) fastest of a geometry's points about its middle [m/s]

    @classmethod
    def empty(cls, model: CollisionModel) -> BodyVelocities:
        n, g = len(model.chain.parent), len(model.bodies.joint)
        return cls(np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((g, 3)), np.zeros(g))


@kernel
def update_body_velocities(model: CollisionModel, data: CollisionData, v: Array, velocities: BodyVelocities) -> None:
    """Velocities of all joint frames and geometries where they are placed, at joint velocities ``v`` (nv,)."""
    chain, bodies, placements, posed = model.chain, model.bodies, data.placements, data.posed
    linear, angular = velocities.linear, velocities.angular
    for i in range(1, chain.parent.shape[0]):
        parent = chain.parent[i]
        _velocity_at(
            linear[parent], angular[parent], placements.translation[parent], placements.translation[i], linear[i]
        )
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
        square = 0.0
        for k in range(3):
            square += angular[joint, k] * angular[joint, k]
        velocities.swing[g] = np.sqrt(square) * bodies.size[g]


@kernel
def _velocity_at(linear: Array, angular: Array, origin: Array, point: Array, out: Array) -> None:
    """Velocity of ``point`` on a link whose frame at ``origin`` moves; ``out`` may be ``point`` itself."""
    x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
    out[0] = linear[0] + angular[1] * z - angular[2] * y
    out[1] = linear[1] + angular[2] * x - angular[0] * z
    out[2] = linear[2] + angular[0] * y - angular[1] * x


@kernel
def fastest_body(velocities: BodyVelocities) -> float:
    """Bound on the speed of any point of any geometry [m/s]."""
    fastest = 0.0
    for g in range(velocities.swing.shape[0]):
        square = 0.0
        for k in range(3):
            square += velocities.middle[g, k] ** 2
        fastest = max(fastest, np.sqrt(square) + velocities.swing[g])
    return fastest


@kernel
def fastest_approach(velocities: BodyVelocities, first: int, second: int) -> float:
    """Bound on how fast two geometries close in [m/s]."""
    square = 0.0
    for k in range(3):
        between = velocities.middle[second, k] - velocities.middle[first, k]
        square += between * between
    return np.sqrt(square) + velocities.swing[first] + velocities.swing[second]
