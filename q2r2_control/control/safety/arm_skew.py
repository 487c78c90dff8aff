"""Prove that two arms stay apart even if one of them is late, or if one of them stops alone (compiled).

One reference moves all arms, but each real arm follows it on its own: one arm may be delayed, and one arm may stop
alone. The path of an arm has two parts: the postures that the reference had in the last ``window`` [s], and the
postures from the present one to the end of the certified stop. It is assumed that each real arm is somewhere on its own
path.

**Claim.** Let n be a unit vector, and c the distance that two bodies of different arms have to keep. The corners e of a
body are the two ends of a segment, or the eight corners of a box. Let

    min over arm 2's path of n'e_2   -   max over arm 1's path of n'e_1   -   radii   >=   c.

Then the distance of the bodies is at least c, wherever on its path each arm is, and whatever the other arm does.
*Proof.* A plane with the normal n separates all positions of one body from all positions of the other body. []

The paths are examined at single instants. Let two neighbouring instants be a time l apart. Between them, a corner
leaves the straight line between its two positions by at most l^2/8 times its greatest acceleration, which is at most

    sum_k reach_k (|a_k| + |v_k| (|v_k| + 2 sum_(i before k) |v_i|))

for the speeds v and accelerations a of the joints that move the corner (separating_plane.py says why).

**Induction.** A step is taken only if the condition of the claim is proven for the path that ends with the step's own
stop. If it is proven for no step, the arms continue along the previous stop. The path of that stop was proven before,
and the arms have only a part of it left. A window that grows no faster than time passes begins at the same posture as
before, so a growing window needs no proof.

Most pairs need no plane. Compare each joint with a motion v t at its present velocity. In the window it deviates from
this motion by at most e_j, which is known; in the step and the stop it deviates by at most rho_j (speed_bound.py). A
body therefore comes closer by at most its own speed times a time, plus the effect of the deviations. This time is the
window or, if that is longer, h + T / 2 for a step of h and a stop of T.
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
    """Write bounds on the motion of all joints along the whole path: window, step and stop.

    The step takes ``h`` [s], and the stop takes ``duration`` [s]. Before this function, call :func:`look_back`,
    :func:`write_step` and :func:`write_deviations`.
    """
    history, v, v_next, candidate = data.history, data.state.v, data.candidate.v, data.candidate
    last = data.rollout.q.shape[0] - 1
    coarse, fine = duration * _stride(data, duration, False) / last, duration * _stride(data, duration, True) / last
    for j in range(v.shape[0]):
        history.deviation[j] = max(data.rollout.deviation[j], history.off[j])
        history.speed[j] = max(abs(v[j]), abs(v_next[j]))
    for j in range(v.shape[0]):
        turned = turning(model.collision, history.speed, j)
        # The acceleration times h^2 is computed as the change of velocity times h, because h may be 0.
        bent = max(history.bend[0, j], 0.125 * (abs(v_next[j] - v[j]) * h + h * h * turned))
        acceleration = (candidate.deceleration[j] if v_next[j] != 0.0 else 0.0) + turned
        history.bend[1, j] = max(bent, 0.125 * coarse * coarse * acceleration)
        history.bend[2, j] = max(bent, 0.125 * fine * fine * acceleration)


@inlined_kernel
def _stride(data: SafetyData, duration: float, finely: bool) -> int:
    """Return the difference between the indices of two neighbouring samples of the stop that are both examined.

    The stop takes ``duration`` [s]. With ``finely``, four times as many samples are examined.
    """
    stride = data.rollout.q.shape[0] - 1
    while stride > 1 and duration * stride / (data.rollout.q.shape[0] - 1) > _STOP_SPACING:
        stride //= 2
    return max(stride // 4, 1) if finely else stride


@inlined_kernel
def is_far(model: SafetyModel, data: SafetyData, p: int, time: float) -> bool:
    """Return whether pair ``p`` is so far apart that it keeps its distance at all points of both arms' paths.

    The last paragraph of this module's docstring has the proof. ``time`` is h + T / 2 [s], the time that counts for the
    step and the stop. Call :func:`write_way` before this function.
    """
    pairs = model.collision.pairs
    speed = speed_of(data.velocities, pairs.first[p]) + speed_of(data.velocities, pairs.second[p])
    closer = speed * max(time, data.history.time[0]) + way(model, p, data.history.deviation)
    return data.distance[p] - closer >= model.min_distance[p]


@kernel
def keeps_apart_at_any_time(model: SafetyModel, data: SafetyData, p: int, duration: float, threshold: float) -> bool:
    """Return whether a separating plane proves that the bodies of pair ``p`` are at least ``threshold`` [m] apart.

    The proof covers every position of both arms on their paths. The stop takes ``duration`` [s].
    """
    measure(model.collision, data.collision, p)
    pairs, bodies = model.collision.pairs, model.collision.bodies
    first, second = pairs.first[p], pairs.second[p]
    needed = threshold + bodies.radius[first] + bodies.radius[second]
    gap = _lowest_on_way(model, data, second, 1.0, duration, False)
    gap += _lowest_on_way(model, data, first, -1.0, duration, False)
    if gap - needed >= way(model, p, data.history.bend[1]):
        return True
    if gap - needed < way(model, p, data.history.bend[2]):
        return False  # More instants can only make the gap smaller, so the finer proof would fail too.
    gap = _lowest_on_way(model, data, second, 1.0, duration, True)
    gap += _lowest_on_way(model, data, first, -1.0, duration, True)
    return gap - needed >= way(model, p, data.history.bend[2])


@kernel
def _lowest_on_way(
    model: SafetyModel, data: SafetyData, body: int, side: float, duration: float, finely: bool
) -> float:
    """Return the least coordinate of a ``body``'s core along ``side`` times the normal on the arm's whole path [m].

    ``side`` is 1 or -1. The path is examined at single instants, more closely with ``finely``.
    """
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
    """Return the least coordinate of a body's core along ``side`` times ``normal`` (3,), for a given posture [m]."""
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
