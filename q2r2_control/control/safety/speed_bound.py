"""Bound on how much closer two geometries come in a step and the stop after it, from how fast they are, compiled.

The bound by reach (stop_certificate.py) takes every joint's way for one that leads straight to the other body. Most
pairs of two moving arms need no more than to know how fast their bodies are: joints that stop together go on as they
began, and arms that move alike do not close in at all (velocity_bounds.py).

**Claim.** Let V be the most that two geometries which share no joint can close in by per second at the reference,
|u_2 - u_1| + |w_1| s_1 + |w_2| s_2, where the joints have the velocities v. Let a step of h lead to v+, and a stop with
the decelerations d_j and the duration T = max |v+_j| / d_j follow. Then the distance is at every moment at least

    d  -  V (h + T / 2)  -  sum_j reach_j (rho_j + kappa_j),

    rho_j = |v+_j - v_j| (h + T) / 2  +  |v+_j| T / 2 - v+_j^2 / 2 d_j,
    kappa_j = w_j (w_j / 2 + sum_(i before j) w_i),

where w_j is the way of joint j in the step and the stop.

*Proof.* Let D(t) be how far the joints have moved, and sigma(t) = t in the step, h + s - s^2 / 2T at the time s of the
stop: at most h + T / 2. Then |D_j - v_j sigma| <= rho_j. In the step it is |v+_j - v_j| t^2 / 2h. In the stop the step
has left |v+_j - v_j| h / 2 of it, v+_j instead of v_j makes |v+_j - v_j| T / 2 more, and a joint that brakes harder
than together lags behind |v+_j| (s - s^2 / 2T) by what only grows until the end, where it is the rest of rho_j. A point
x of a body gets to x + J D + R, with |R| <= sum reach_j kappa_j over the joints that move it (separating_plane.py has
why), so that two points get closer by at most |(J_2 - J_1) v| sigma + sum reach_j (rho_j + kappa_j), and
|(J_2 - J_1) v| is at most V. []

A joint that carries both bodies is in V, but changes no distance: turning with the bodies, it could hide that these
close in. So pairs with such a joint are left to the other proofs.
"""

from __future__ import annotations

from q2r2_control.control.jit import inlined_kernel, lean_kernel
from q2r2_control.control.safety.safety_data import SafetyData
from q2r2_control.control.safety.safety_model import SafetyModel
from q2r2_control.control.safety.velocity_bounds import fastest_approach
from q2r2_control.types import Array


@lean_kernel
def write_astray(model: SafetyModel, data: SafetyData, h: float, duration: float) -> None:
    """rho + kappa of every joint [rad or m], in a step of ``h`` to the candidate and a stop of ``duration`` [s].

    Needs the ways of both.
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
        rollout.astray[j] = rho + w * (0.5 * w + before)


@inlined_kernel
def least_distance(model: SafetyModel, data: SafetyData, p: int, time: float) -> float:
    """Least distance [m] of pair ``p``, which shares no joint, in the step and the stop; ``time`` is h + T / 2 [s].

    Needs :func:`write_astray`, and ``data.distance`` at the reference or a lower bound of it.
    """
    pairs = model.collision.pairs
    approach = fastest_approach(data.velocities, pairs.first[p], pairs.second[p])
    return data.distance[p] - approach * time - way(model, p, data.rollout.astray)


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
