"""Prove that two arms stay apart if one of them is late, or stands still while the other one stops (compiled).

One reference moves all arms. Each real arm follows it on its own: the answers of one may come later, and one may stop
alone. Let a real arm be nowhere but on its own way, which is where the reference had it in the last ``window`` [s], and
from there to the end of the certified stop.

**Claim.** Let n be a unit vector and c the distance that two bodies of different arms keep. Of the corners e of both
bodies (the ends of a segment, the corners of a box) let

    min over arm 2's way of n'e_2   -   max over arm 1's way of n'e_1   -   radii   >=   c.

Then the bodies are c apart wherever on its way each arm is, whatever the other one does. *Proof.* The plane between
them lies beyond all places of either body. []

The ways are examined from instant to instant. Let two of them be a time l apart. Between them, a corner is off the
straight line between its places by at most l^2/8 of its greatest acceleration. That is at most

    sum_k reach_k (|a_k| + |v_k| (|v_k| + 2 sum_(i before k) |v_i|))

for speeds v and accelerations a of the joints that move it (separating_plane.py has why).

**Induction.** A step is taken only if that is proven for the way that ends with its own stop. If it is proven for no
step, the arms go on along the stop before. That way was proven then, and the window leaves more and more of it behind.
A window that grows no faster than time passes begins where it began before, and so it needs no proof.

Most pairs need no plane. Compared with v t, a joint is off by e_j at most in the window, which is known, and by rho_j
in the step and the stop (speed_bound.py). Neither body then comes closer to the other by more than its own speed times
the longer of both times, and what the joints are off.
"""

from __future__ import annotations

from q2r2_control.control.geometry.collision import BodyPlacements, CollisionBodies, update_placements
from q2r2_control.control.geometry.pair_distance import measure
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.control.kernel_pointers import pointee_at
from q2r2_control.control.safety.reference_history import turning
from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel
from q2r2_control.control.safety.speed_bound import speed_of, way
from q2r2_control.control.safety.stop_rollout import sample_of
from q2r2_control.types import Array

_STOP_SPACING = 0.015  # Longest time between two examined instants of a stop [s].


@kernel
def write_way(model: SafetyModel, data: SafetyData, h: float, duration: float) -> None:
    """Write bounds on all joints along their whole way, with a step of ``h`` and a stop of ``duration`` [s].

    It needs :func:`look_back`, and the data that the other proofs write about the step and the stop.
    """
    history, v, v_next, candidate = data.history, data.state.v, data.candidate.v, data.candidate
    last = data.rollout.q.shape[0] - 1
    coarse, fine = duration * _stride(data, duration, False) / last, duration * _stride(data, duration, True) / last
    for j in range(v.shape[0]):
        history.deviation[j] = max(data.rollout.deviation[j], history.off[j])
        history.speed[j] = max(abs(v[j]), abs(v_next[j]))
    for j in range(v.shape[0]):
        turned = turning(model.collision, history.speed, j)
        # The acceleration times h^2 is the change of speed times h, also where h is 0.
        bent = max(history.bend[0, j], 0.125 * (abs(v_next[j] - v[j]) * h + h * h * turned))
        acceleration = (candidate.deceleration[j] if v_next[j] != 0.0 else 0.0) + turned
        history.bend[1, j] = max(bent, 0.125 * coarse * coarse * acceleration)
        history.bend[2, j] = max(bent, 0.125 * fine * fine * acceleration)


@inlined_kernel
def _stride(data: SafetyData, duration: float, finely: bool) -> int:
    """Return the number of samples from one examined instant of a stop to the next, for ``duration`` [s]."""
    stride = data.rollout.q.shape[0] - 1
    while stride > 1 and duration * stride / (data.rollout.q.shape[0] - 1) > _STOP_SPACING:
        stride //= 2
    return max(stride // 4, 1) if finely else stride


@inlined_kernel
def is_far(model: SafetyModel, data: SafetyData, p: int, time: float) -> bool:
    """Return whether pair ``p`` of two arms is too far apart to meet on their own ways; see the claim's end.

    ``time`` is the time of the step and the stop, h + T / 2 [s]. It needs :func:`write_way`.
    """
    pairs = model.collision.pairs
    speed = speed_of(data.velocities, pairs.first[p]) + speed_of(data.velocities, pairs.second[p])
    closer = speed * max(time, data.history.time[0]) + way(model, p, data.history.deviation)
    return data.distance[p] - closer >= model.min_distance[p]


@kernel
def keeps_apart_at_any_time(model: SafetyModel, data: SafetyData, p: int, duration: float, threshold: float) -> bool:
    """Return whether a plane proves pair ``p`` beyond ``threshold`` [m] at all places of both arms' ways."""
    measure(model.collision, data.collision, p)
    pairs, bodies = model.collision.pairs, model.collision.bodies
    first, second = pairs.first[p], pairs.second[p]
    needed = threshold + bodies.radius[first] + bodies.radius[second]
    gap = _lowest_on_way(model, data, second, 1.0, duration, False)
    gap += _lowest_on_way(model, data, first, -1.0, duration, False)
    if gap - needed >= way(model, p, data.history.bend[1]):
        return True
    if gap - needed < way(model, p, data.history.bend[2]):
        return False  # More instants would find no more room.
    gap = _lowest_on_way(model, data, second, 1.0, duration, True)
    gap += _lowest_on_way(model, data, first, -1.0, duration, True)
    return gap - needed >= way(model, p, data.history.bend[2])


@kernel
def _lowest_on_way(
    model: SafetyModel, data: SafetyData, body: int, side: float, duration: float, finely: bool
) -> float:
    """Return the least place of a ``body``'s core along the normal times ``side``, at all examined instants [m]."""
    collision, bodies, history = model.collision, model.collision.bodies, data.history
    normal = data.collision.contact.normal
    lowest = _lowest(bodies, data.collision.posed, body, side, normal)
    i, stride, last = 0, _stride(data, duration, finely), data.rollout.q.shape[0] - 1
    while i <= last:
        sample = sample_of(model, data, i, duration)
        lowest = min(lowest, _lowest(bodies, sample.posed, body, side, normal))
        i += stride
    for i in range(history.counted[0]):
        past = pointee_at(history.samples, i)
        if history.known[i] == 0.0:
            update_placements(collision, past, history.q[i])
            history.known[i] = 1.0
        lowest = min(lowest, _lowest(bodies, past.posed, body, side, normal))
    return lowest


@inlined_kernel
def _lowest(bodies: CollisionBodies, posed: BodyPlacements, body: int, side: float, normal: Array) -> float:
    """Return the least place of a body's core along ``normal`` (3,) times ``side`` [m]."""
    start, end, beside = 0.0, 0.0, 0.0
    for k in range(3):
        start += side * normal[k] * posed.start[body, k]
        end += side * normal[k] * posed.end[body, k]
    if bodies.box[body] == 1:
        for axis in range(3):
            along = 0.0
            for k in range(3):
                along += normal[k] * posed.rotation[body, k, axis]
            beside += bodies.half[body, axis] * abs(along)
    return min(start, end) - beside
