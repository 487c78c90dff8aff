"""Distances of all monitored pairs at the reference, and which of them a row may bind, compiled."""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.pair_distance import at_least, measure
from q2r2_control.control.jit import kernel
from q2r2_control.control.safety.safety_data import SafetyData
from q2r2_control.control.safety.safety_model import SafetyModel
from q2r2_control.control.safety.velocity_bounds import fastest_approach, fastest_body


@kernel
def measure_pairs(model: SafetyModel, data: SafetyData) -> int:
    """Measure every pair at the reference; returns the closest one.

    Needs the placements and velocities there. ``data.distance`` receives the exact distance where it matters (a row
    could bind, the closest pair) and a lower bound elsewhere, ``data.near`` where a row could bind.
    """
    collision, approach, distance, v = model.collision, model.approach, data.distance, data.state.v
    pairs = collision.pairs
    closest = 0
    least = np.inf
    surge = 0.0
    duration = 0.0
    for j in range(v.shape[0]):
        surge = max(surge, model.limits.acceleration[j] * model.limits.longest_step)
        duration = max(duration, abs(v[j]) / data.certified[j])
    horizon = 2.0 / approach.gain[0] + 0.5 * duration
    fastest = 2.0 * fastest_body(data.velocities)
    for p in range(pairs.first.shape[0]):
        data.near[p] = 0
        if model.min_distance[p] == -np.inf:  # of an object that is not held
            distance[p] = np.inf
            continue
        distance[p] = at_least(collision, data.collision, p)
        # The fastest that the pair can close in after this step. Farther than twice what the gain needs for that, and
        # the way of the stop, a row would bind at very low leverage: it would add comfort, and safety needs none.
        always = approach.stop_distance[p] + approach.contact_zone[p] + horizon * pairs.leverage[p] * surge
        far = distance[p] >= least
        if far and distance[p] > always + horizon * fastest:
            continue  # whichever its bodies are, without a look at them
        relevant = always + horizon * fastest_approach(data.velocities, pairs.first[p], pairs.second[p])
        if far and distance[p] > relevant:
            continue
        distance[p] = measure(collision, data.collision, p)
        if distance[p] < least:
            least = distance[p]
            closest = p
        data.near[p] = 1 if distance[p] <= relevant else 0
    return closest
