"""Move the reference by the part of the solver's velocities that can be certified (compiled).

The data always contain the stop that was certified last; it is called the known stop. If nothing better can be
certified in a step, the next part of the known stop is executed. The remaining part of it stays certified
(stop_certificate.py).
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp, dot
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.geometry.pair_distance import at_least, measure
from q2r2_control.control.jit import kernel
from q2r2_control.control.safety.joint_limits import ACCELERATION, NO_LIMIT
from q2r2_control.control.safety.reference_history import remember
from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel
from q2r2_control.control.safety.speed_bound import fastest_approach, fastest_body, speed_of
from q2r2_control.control.safety.stop_certificate import certify, is_too_close
from q2r2_control.control.safety.stop_rollout import SHAPES, TOGETHER, brake, stay_with_stop, write_stop
from q2r2_control.control.safety.tool_speed import keeps_tool_speed
from q2r2_control.types import Array

FOLLOWED, REDUCED, STOPPED = 0, 1, 2
SEPARATION = ACCELERATION + 1  # The kind of limit that keeps two bodies apart.
TOOL_SPEED = SEPARATION + 1  # The kind of limit that bounds the speed of a tool.
_BISECTIONS = 4
_ACTIVE = 1e-7  # A velocity that is this near to a bound counts as at the bound [rad/s].


@kernel
def apply_safety_filter(
    model: SafetyModel, data: SafetyData, solution: Array, usable: bool, h: float, share: float
) -> tuple[int, float]:
    """Move the reference by one step.

    Args:
        model: The model.
        data: The data.
        solution: The solver's next velocities (nv,) [rad/s].
        usable: Whether there is a solution. If not, the known stop is executed.
        h: Duration of the step [s].
        share: Duration of the step divided by the duration of the tick. It is the weight of the step's acceleration in
            the tick's mean acceleration.

    Returns:
        FOLLOWED, REDUCED towards the stop, or STOPPED; and the largest violation of a row [rad/s].
    """
    q, v, candidate = data.state.q, data.state.v, data.candidate
    outcome = STOPPED
    data.tools.held[:] = 0
    if usable:
        total = 0.0
        for j in range(q.shape[0]):
            # The solution may leave the box by the solver's tolerance. NaN may pass a clamp, but ``total`` is then NaN.
            total += solution[j]
            data.wanted[j] = clamp(solution[j], data.box.lower[j], data.box.upper[j])
            total += data.wanted[j]
        if np.isfinite(total):
            outcome = _largest_certified(model, data, h)
    if outcome == STOPPED:
        brake(q, v, data.certified, h, candidate.q, candidate.v)
    remember(data.history, q, v, candidate.v, h)
    for j in range(q.shape[0]):
        # The velocities keep the acceleration limit, but their difference divided by a tiny h may exceed it by
        # rounding. The quotient is therefore clamped.
        limit = model.limits.acceleration[j]
        data.state.a[j] += share * clamp((candidate.v[j] - v[j]) / h, -limit, limit)
        q[j] = candidate.q[j]
        v[j] = candidate.v[j]
    slack = _note_active(data)
    if outcome == STOPPED:
        _note_too_close(model, data)
    return outcome, slack


@kernel
def certify_start(model: SafetyModel, data: SafetyData) -> bool:
    """Find a full stop from the reference that keeps all pairs apart; return whether there is such a stop.

    The stop that is found becomes the known stop. If no shape of stop can be certified, the joints stop together.
    """
    stay_with_stop(data)
    proven = _some_stop_certified(model, data, 0.0, SHAPES)
    if not proven:
        write_stop(model, data.state.q, data.state.v, TOGETHER, data.candidate.deceleration)
    _keep_stop(data)
    return proven


@kernel
def certify_bodies(model: SafetyModel, data: SafetyData, grown: IntArray) -> int:
    """Return the first pair that forbids its bodies to grow; -1 if no pair forbids this.

    Some bodies in ``model`` are larger than when the reference was certified. This is allowed if two conditions hold.
    At the reference, each pair of these bodies keeps its distance. During the known stop, all pairs keep their
    distances. The known stop is then certified for the larger bodies too. No other stop is tried, because the arms may
    already be braking along the known stop.

    Args:
        model: The model, with the grown bodies.
        data: The data.
        grown: 1 for each body that has grown (g,).
    """
    pairs, any_grown = model.collision.pairs, False
    for p in range(pairs.first.shape[0]):
        if grown[pairs.first[p]] == 1 or grown[pairs.second[p]] == 1:
            any_grown = True
            if data.distance[p] < model.min_distance[p]:  # No rounding is tolerated: to refuse growth does no harm.
                return p
    stay_with_stop(data)
    if not any_grown or certify(model, data, 0.0):
        return -1
    return data.unproven[0]


@kernel
def _keep_stop(data: SafetyData) -> None:
    """Make the stop of the candidate the known stop."""
    for j in range(data.candidate.v.shape[0]):
        data.certified[j] = data.candidate.deceleration[j]


@kernel
def _largest_certified(model: SafetyModel, data: SafetyData, h: float) -> int:
    """Make the wanted velocities the candidate, or else the largest certified mixture of them and the known stop.

    Returns FOLLOWED, REDUCED or STOPPED. The velocities of the known stop and the wanted velocities both lie in the
    box. Since the box is convex, every mixture of them lies in it too.
    """
    too_close = False
    for p in range(data.distance.shape[0]):
        too_close |= is_too_close(model, data, p)
    brake(data.state.q, data.state.v, data.certified, h, data.candidate.q, data.braked)
    if _certify_mixture(model, data, 1.0, h, too_close):
        _keep_stop(data)
        return FOLLOWED
    unproven = data.unproven[0]
    if unproven >= 0 and is_too_close(model, data, unproven) and not data.state.v.any():
        # From rest, a smaller motion would bring the pair closer too. No mixture is tried, because this would only take
        # time.
        return STOPPED
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        share = 0.5 * (low + high)
        if _certify_mixture(model, data, share, h, too_close):
            _keep_stop(data)
            low = share
        else:
            high = share
    if low == 0.0:
        return STOPPED
    _mix(data, low, h)
    return REDUCED


@kernel
def _certify_mixture(model: SafetyModel, data: SafetyData, share: float, h: float, together: bool) -> bool:
    """Make a mixture the candidate; return whether it can be certified with some shape of stop.

    Args:
        model: The model.
        data: The data.
        share: Share of the wanted velocities in the mixture, from 0 for the known stop to 1.
        h: Duration of the step [s].
        together: True if a pair is too close. Only a stop of all joints together is then tried: during this stop, a
            distance that grows continues to grow.
    """
    _mix(data, share, h)
    return _some_stop_certified(model, data, h, 1 if together else SHAPES)


@kernel
def _some_stop_certified(model: SafetyModel, data: SafetyData, h: float, shapes: int) -> bool:
    """Try the first ``shapes`` shapes of a stop; return whether the candidate is certified with one of them.

    The candidate keeps the stop with which it is certified.
    """
    data.unproven[0] = -1
    for shape in range(shapes):
        write_stop(model, data.candidate.q, data.candidate.v, shape, data.candidate.deceleration)
        if keeps_tool_speed(model, data, h) and certify(model, data, h):
            return True
    return False


@kernel
def _mix(data: SafetyData, share: float, h: float) -> None:
    """Write the candidate's velocities, and the positions that follow from them.

    They are (1 - ``share``) times the velocities of the known stop plus ``share`` times the wanted velocities.
    """
    state, candidate = data.state, data.candidate
    for j in range(state.q.shape[0]):
        braked, wanted = data.braked[j], data.wanted[j]
        candidate.v[j] = wanted if share == 1.0 else braked + share * (wanted - braked)
        candidate.q[j] = state.q[j] + 0.5 * h * (state.v[j] + candidate.v[j])


@kernel
def _note_active(data: SafetyData) -> float:
    """List the limits, pairs and tools that limit the new velocities.

    Returns the largest violation of all separation rows [rad/s]; 0 if every row is satisfied.
    """
    v, box, rows, active = data.state.v, data.box, data.rows, data.active
    count = 0
    for j in range(v.shape[0]):
        kind = NO_LIMIT
        if v[j] >= box.upper[j] - _ACTIVE:
            kind = box.upper_limit[j]
        elif v[j] <= box.lower[j] + _ACTIVE:
            kind = box.lower_limit[j]
        if kind != NO_LIMIT:
            active.kind[count], active.subject[count] = kind, j
            count += 1
    slack = 0.0
    for i in range(rows.used[0]):
        rate = dot(rows.matrix[i], v)
        slack = max(slack, rows.lower[i] - rate)
        if rate <= rows.lower[i] + _ACTIVE:
            active.kind[count], active.subject[count] = SEPARATION, rows.pair[i]
            count += 1
    for i in range(data.tools.held.shape[0]):
        if data.tools.held[i] == 1:
            active.kind[count], active.subject[count] = TOOL_SPEED, i
            count += 1
    active.used[0] = count
    return slack


@kernel
def _note_too_close(model: SafetyModel, data: SafetyData) -> None:
    """List the pairs that are too close. Because of them, no solution could be certified."""
    active = data.active
    for p in range(data.distance.shape[0]):
        count = active.used[0]
        if is_too_close(model, data, p) and count < active.kind.shape[0]:
            active.kind[count], active.subject[count], active.used[0] = SEPARATION, p, count + 1


@kernel
def measure_pairs(model: SafetyModel, data: SafetyData) -> int:
    """Measure the pairs at the reference; return the index of the closest pair.

    ``data`` has to contain the placements and velocities of the bodies at the reference. ``data.distance`` gets the
    exact distance of the closest pair and of pairs whose rows may bind, and a lower bound for other pairs.
    ``data.near`` marks the pairs whose rows may bind.
    """
    collision, approach, distance, v = model.collision, model.approach, data.distance, data.state.v
    pairs = collision.pairs
    closest, least, surge, duration = 0, np.inf, 0.0, 0.0
    for j in range(v.shape[0]):
        surge = max(surge, model.limits.acceleration[j] * model.limits.longest_step)
        duration = max(duration, abs(v[j]) / data.certified[j])
    horizon = 2.0 / approach.gain[0] + 0.5 * duration
    fastest = 2.0 * fastest_body(data.velocities)
    for p in range(pairs.first.shape[0]):
        data.near[p] = 0
        if model.min_distance[p] == -np.inf:  # The pair's object is not held, or the pair's obstacle is not present.
            distance[p] = np.inf
            continue
        distance[p] = at_least(collision, data.collision, p)
        # Let s be the greatest speed at which the pair can close in after this step. A stop that takes T uses up
        # s T / 2 of the free distance. At the speed s a row binds if the free distance is below s / gain. A pair whose
        # free distance is more than s T / 2 + 2 s / gain gets no row. Rows are not needed for safety.
        always = approach.stop_distance[p] + approach.contact_zone[p] + horizon * pairs.leverage[p] * surge
        far = distance[p] >= least
        if far and distance[p] > always + horizon * fastest:
            continue  # ``fastest`` bounds the approach speed of any two bodies, so this pair needs no measurement.
        first, second = pairs.first[p], pairs.second[p]
        if data.history.window[0] > 0.0 and model.of_two_arms[p] == 1:
            # One arm may stop while the other arm moves, so the speeds of both bodies are added.
            approach_speed = speed_of(data.velocities, first) + speed_of(data.velocities, second)
        else:
            approach_speed = fastest_approach(data.velocities, first, second)
        relevant = always + horizon * approach_speed
        if far and distance[p] > relevant:
            continue
        distance[p] = measure(collision, data.collision, p)
        if distance[p] < least:
            closest, least = p, distance[p]
        data.near[p] = 1 if distance[p] <= relevant else 0
    return closest
