"""Bound on how much closer two geometries come in a step and the stop after it, from how fast they are, compiled.

The bound by reach (stop_certificate.py) takes every joint's way for one that leads straight to the other body. Most
pairs of two moving arms need no more than to know how fast their bodies are: joints that stop together go on as they
began, and arms that move alike do not close in at all (velocity_bounds.py).

**Claim.** Let d be the distance of two bodies at the reference that share no joint, and V the most that they can close
in by per second there, |u_2 - u_1| + |w_1| s_1 + |w_2| s_2, where the joints have the velocities v. Let a step of h
lead to v+, and a stop with the decelerations d_j and the duration T = max |v+_j| / d_j follow. Then their distance is
always at least

    d  -  V (h + T / 2)  -  sum_j reach_j (rho_j + kappa_j),

    rho_j = |v+_j - v_j| (h + T) / 2  +  |v+_j| T / 2 - v+_j^2 / 2 d_j,
    kappa_j = w_j (w_j / 2 + sum_(i before j) w_i),

where w_j is the way of joint j in the step and the stop.

*Proof.* Let D_j(t) be how far joint j has moved. Compare it with v_j sigma(t), where sigma = t in the step and sigma =
h + s - s^2 / 2T at the time s of the stop, so at most h + T / 2. In the step, |D_j - v_j t| = |v+_j - v_j| t^2 / 2h is
at most |v+_j - v_j| h / 2, and no more is left of it in the stop. There, v+_j takes the place of v_j, which changes v_j
(s - s^2 / 2T) by at most |v+_j - v_j| T / 2. The joint itself travels B_j(s) from the step's end; since d_j >= |v+_j| /
T, the difference |v+_j| (s - s^2 / 2T) - |B_j(s)| is never negative and never falls, and at T it is |v+_j| T / 2 -
v+_j^2 / 2 d_j. Together |D_j - v_j sigma| <= rho_j. A point of a body moves by J D + R, with |R| <= sum reach_j kappa_j
over the joints that move it (separating_plane.py has why). So two points, one of each body's core, get closer by at
most |(J_2 - J_1) v| sigma + sum reach_j (rho_j + kappa_j), and |(J_2 - J_1) v| <= V. The radii cancel. []

The velocity of a joint that carries both bodies is part of V, but such a joint is not in the sum: V could then be less
than how fast the bodies close in. So pairs that share a joint are left to the other proofs.
"""

from __future__ import annotations

from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel
from q2r2_control.control.safety.velocity_bounds import fastest_approach
from q2r2_control.types import Array


@kernel
def write_deviations(model: SafetyModel, data: SafetyData, h: float, duration: float) -> float:
    """rho + kappa of every joint [rad or m], in a step of ``h`` to the candidate and a stop of ``duration`` [s].

    Needs the ways of both. Returns h + T / 2 [s].
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
    """Least distance [m] of pair ``p``, which shares no joint, in the step and the stop; ``time`` is h + T / 2 [s].

    Needs :func:`write_deviations`. ``data.velocities`` are those at the reference, of the bodies as they are now, and
    ``data.distance`` is measured there, or a lower bound.
    """
    pairs = model.collision.pairs
    approach = fastest_approach(data.velocities, pairs.first[p], pairs.second[p])
    return data.distance[p] - approach * time - way(model, p, data.rollout.deviation)


@inlined_kernel
def way(model: SafetyModel, p: int, travel: Array) -> float:
    """How far the bodies of pair ``p`` can have moved relative to each other when joints travel (nv,) [m]."""
    pairs = model.collision.pairs
    total = 0.0
    for k in range(pairs.joint.shape[1]):
        joint = pairs.joint[p, k]
        if joint == 0:
            break
        total += pairs.reach[p, k] * travel[joint - 1]
    return total
