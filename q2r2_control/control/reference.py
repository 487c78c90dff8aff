"""Observe the reference, and move it as far as the safety filter allows (compiled).

To observe the reference means to compute the tool poses, the bodies' poses and the pairs' distances at its posture.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.collision import update_placements
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.geometry.pair_distance import at_least, measure
from q2r2_control.control.jit import kernel
from q2r2_control.control.kernel_model import KernelData, KernelModel
from q2r2_control.control.kernel_pointers import KernelPointer, pointee
from q2r2_control.control.safety.reference_history import look_back, rest_always
from q2r2_control.control.safety.safety_filter import apply_safety_filter, certify_bodies, certify_start, measure_pairs
from q2r2_control.control.safety.speed_bound import update_body_velocities
from q2r2_control.control.tasks.frame import tool_pose
from q2r2_control.types import Array

# The closest pair and its distance [m], and the pair with the least margin and this margin [m]. The margin of a pair is
# its distance minus its kept distance. Both numbers are infinite if there is no pair.
Observed = tuple[int, float, int, float]


@kernel
def start_reference(model_pointer: KernelPointer, data_pointer: KernelPointer) -> bool:
    """Observe the reference after a reset. Return whether a stop from it is proven to keep all pairs apart."""
    model, data = pointee(model_pointer), pointee(data_pointer)
    rest_always(data.safety.history, data.safety.state.q)
    _observe(model, data)
    return certify_start(model.safety, data.safety)


@kernel
def observe_bodies(model_pointer: KernelPointer, data_pointer: KernelPointer, grown: IntArray) -> tuple[Observed, int]:
    """Observe the reference after bodies or kept distances have changed. ``grown`` (g,) marks bodies that have grown.

    Returns what was observed, and the first pair that does not allow the grown bodies (:func:`certify_bodies`); -1 if
    all pairs allow them.
    """
    model, data = pointee(model_pointer), pointee(data_pointer)
    return _observe(model, data), certify_bodies(model.safety, data.safety, grown)


@kernel
def move_reference(
    model_pointer: KernelPointer, data_pointer: KernelPointer, solution: Array, usable: bool, h: float, share: float
) -> tuple[Observed, int, float]:
    """Do one step of ``h`` [s] with the solver's next velocities (nv,) [rad/s], and observe the reference.

    Returns what was observed, and the two results of :func:`apply_safety_filter`, which has the same last arguments.
    """
    model, data = pointee(model_pointer), pointee(data_pointer)
    outcome, slack = apply_safety_filter(model.safety, data.safety, solution, usable, h, share)
    return _observe(model, data), outcome, slack


@kernel
def spare_distance(model_pointer: KernelPointer, data_pointer: KernelPointer, pairs: IntArray) -> float:
    """Return the least margin among the ``pairs`` with these indices [m]; infinite if there are none.

    The margin of a pair is its distance at the reference minus its kept distance.
    """
    model, data = pointee(model_pointer).safety, pointee(data_pointer).safety
    least = np.inf
    for p in pairs:
        if at_least(model.collision, data.collision, p) - model.min_distance[p] < least:
            least = min(least, measure(model.collision, data.collision, p) - model.min_distance[p])
    return least


@kernel
def _observe(model: KernelModel, data: KernelData) -> Observed:
    """Observe the reference, as the module's docstring says."""
    collision, safety = model.safety.collision, data.safety
    update_placements(collision, safety.collision, safety.state.q)
    update_body_velocities(collision, safety.collision, safety.state.v, safety.velocities)
    look_back(collision, safety.history, safety.state.q, safety.state.v)
    for i in range(model.tasks.tools.joint.shape[0]):
        tool_pose(data.tasks.placements, model.tasks.tools, i, data.tasks.rotation[i], data.tasks.translation[i])
    if safety.distance.shape[0] == 0:
        return 0, np.inf, 0, np.inf
    closest = measure_pairs(model.safety, safety)
    while True:  # Lower bounds are replaced by exact distances until the smallest margin is exact.
        tightest, least = 0, np.inf
        for p in range(safety.distance.shape[0]):
            margin = safety.distance[p] - model.safety.min_distance[p]
            if margin < least:
                tightest, least = p, margin
        distance = measure(collision, safety.collision, tightest)
        if not distance > safety.distance[tightest]:
            return closest, safety.distance[closest], tightest, least
        safety.distance[tightest] = distance
