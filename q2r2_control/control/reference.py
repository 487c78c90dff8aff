"""The reference: observed where it is, moved by what the safety filter lets through, compiled."""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.collision import update_placements
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.geometry.pair_distance import at_least, measure
from q2r2_control.control.jit import KernelPointer, kernel, pointee
from q2r2_control.control.kernel_model import KernelData, KernelModel
from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel
from q2r2_control.control.safety.safety_filter import apply_safety_filter, certify_bodies, certify_start, measure_pairs
from q2r2_control.control.safety.velocity_bounds import update_body_velocities
from q2r2_control.control.tasks.frame import tool_pose
from q2r2_control.types import Array


@kernel
def start_reference(model_pointer: KernelPointer, data_pointer: KernelPointer) -> tuple[int, float, int, float, bool]:
    """Observe after a reset: what :func:`_observe` says, and whether the stop is known to keep all apart."""
    model, data = pointee(model_pointer), pointee(data_pointer)
    closest, distance, tightest, margin = _observe(model, data)
    return closest, distance, tightest, margin, certify_start(model.safety, data.safety)


@kernel
def observe_bodies(
    model_pointer: KernelPointer, data_pointer: KernelPointer, grown: IntArray
) -> tuple[int, float, int, float, int]:
    """Observe with bodies that were changed, some ``grown`` (g,): what :func:`_observe` says, and the pair in the way.

    That is what :func:`certify_bodies` says: -1 where the bodies may be as they are.
    """
    model, data = pointee(model_pointer), pointee(data_pointer)
    closest, distance, tightest, margin = _observe(model, data)
    return closest, distance, tightest, margin, certify_bodies(model.safety, data.safety, grown)


@kernel
def move_reference(
    model_pointer: KernelPointer, data_pointer: KernelPointer, solution: Array, usable: bool, h: float, share: float
) -> tuple[int, int, float, int, float, float]:
    """One step of ``h`` [s] with the solver's next velocities (nv,), as far as :func:`apply_safety_filter` takes them.

    Returns its outcome, what :func:`_observe` says of the new state, and the largest violation of a row [rad/s].
    """
    model, data = pointee(model_pointer), pointee(data_pointer)
    outcome, slack = apply_safety_filter(model.safety, data.safety, solution, usable, h, share)
    closest, distance, tightest, margin = _observe(model, data)
    return outcome, closest, distance, tightest, margin, slack


@kernel
def spare_distance(model_pointer: KernelPointer, data_pointer: KernelPointer, pairs: IntArray) -> float:
    """The least that some ``pairs`` (p,) have to spare at the reference [m]: their distance less what they keep."""
    model, data = pointee(model_pointer).safety, pointee(data_pointer).safety
    least = np.inf
    for p in pairs:
        if at_least(model.collision, data.collision, p) - model.min_distance[p] < least:
            least = min(least, measure(model.collision, data.collision, p) - model.min_distance[p])
    return least


@kernel
def _observe(model: KernelModel, data: KernelData) -> tuple[int, float, int, float]:
    """Tool poses and distances at the reference.

    Returns the closest pair and its distance, and the pair with the least margin and that, which is its distance less
    what it keeps [m]; both infinite if there is no pair.
    """
    collision, safety = model.safety.collision, data.safety
    update_placements(collision, safety.collision, safety.state.q)
    update_body_velocities(collision, safety.collision, safety.state.v, safety.velocities)
    for i in range(model.tasks.tools.joint.shape[0]):
        tool_pose(data.tasks.placements, model.tasks.tools, i, data.tasks.rotation[i], data.tasks.translation[i])
    if safety.distance.shape[0] == 0:
        return 0, np.inf, 0, np.inf
    closest = measure_pairs(model.safety, safety)
    tightest = _tightest(model.safety, safety)
    margin = safety.distance[tightest] - model.safety.min_distance[tightest]
    return closest, safety.distance[closest], tightest, margin


@kernel
def _tightest(model: SafetyModel, data: SafetyData) -> int:
    """The pair with the least margin. What is a lower bound of a distance is measured until the least one is none."""
    while True:
        tightest = 0
        least = np.inf
        for p in range(data.distance.shape[0]):
            margin = data.distance[p] - model.min_distance[p]
            if margin < least:
                least = margin
                tightest = p
        distance = measure(model.collision, data.collision, tightest)
        if not distance > data.distance[tightest]:
            return tightest
        data.distance[tightest] = distance
