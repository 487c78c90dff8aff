"""Take the solver's velocities as far as they can be certified, and move the reference, compiled."""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp
from q2r2_control.control.jit import Held, kernel, lean_kernel
from q2r2_control.control.kernel_data import Cell, Workspace
from q2r2_control.control.qp_assembly import observe
from q2r2_control.control.safety.joint_limits import NO_LIMIT
from q2r2_control.control.safety.stop_certificate import brake, certify, stop_together
from q2r2_control.types import Array

FOLLOWED, REDUCED, STOPPED = 0, 1, 2
_BISECTIONS = 4
_ACTIVE = 1e-7  # [rad/s] from a bound


@kernel
def commit(
    held_cell: Held, held_work: Held, solution: Array, usable: bool, h: float, share: float
) -> tuple[int, int, float, float]:
    """One step of ``h`` with the solver's next velocities ``solution`` (nv,), or the stop if they are not ``usable``.

    ``share`` is the step's part of the tick, whose mean acceleration it adds to. Returns what was done (FOLLOWED,
    REDUCED towards the stop, STOPPED), the closest pair at the new state, its distance [m] (infinite if there is no
    pair), and the largest violation of a row [rad/s].
    """
    cell, work = held_cell.value, held_work.value
    q, v = work.q, work.v
    outcome = STOPPED
    if usable:
        for j in range(q.shape[0]):
            # A solver's tolerance is larger than the contract's. NaN passes through clamps: the sum shows it.
            work.wanted[j] = clamp(solution[j], work.box_lower[j], work.box_upper[j])
        if np.isfinite(np.sum(work.wanted)) and np.isfinite(np.sum(solution)):
            outcome = _largest_certified(cell, work, h)
    if outcome == STOPPED:
        # The last certified stop; what is left of it stays certified: see braking.py.
        brake(q, v, work.deceleration[0], h, work.candidate[1], work.candidate[0])
    for j in range(q.shape[0]):
        # Rounding of a difference over a tiny h may exceed the limit that the velocities keep.
        rate = clamp((work.candidate[0, j] - v[j]) / h, -cell.acceleration[j], cell.acceleration[j])
        work.a[j] += share * rate
        q[j] = work.candidate[1, j]
        v[j] = work.candidate[0, j]
    slack = _note_active(work)
    closest = observe(cell, work)
    return outcome, closest, _distance_of(work, closest), slack


@kernel
def first_look(held_cell: Held, held_work: Held) -> tuple[int, float, bool]:
    """Observe after a reset: the closest pair, its distance, and whether the stop is known to keep all apart."""
    cell, work = held_cell.value, held_work.value
    closest = observe(cell, work)
    work.candidate[0] = work.v
    work.candidate[1] = work.q
    work.deceleration[0] = cell.acceleration
    work.deceleration[1] = cell.acceleration
    return closest, _distance_of(work, closest), _certified(cell, work, 0.0)


@lean_kernel
def _distance_of(work: Workspace, pair: int) -> float:
    return work.distance[pair] if work.distance.shape[0] > 0 else np.inf


@lean_kernel
def _certified(cell: Cell, work: Workspace, h: float) -> bool:
    return certify(
        cell.chain,
        work.placements,
        cell.bodies,
        cell.pairs,
        work.distance,
        work.posed,
        work.v,
        work.candidate[1],
        work.candidate[0],
        work.deceleration[1],
        h,
        cell.limits.min_distance,
        work.rollout,
    )


@lean_kernel
def _largest_certified(cell: Cell, work: Workspace, h: float) -> int:
    """Write into ``work.candidate`` the wanted velocities if they can be certified, else the most of them that can.

    The certified stop lies in the box as the wanted velocities do, and the box is convex, so every mixture lies in it.
    """
    too_close = False
    for p in range(work.distance.shape[0]):
        too_close |= work.distance[p] < cell.limits.min_distance
    brake(work.q, work.v, work.deceleration[0], h, work.candidate[1], work.candidate[2])
    low = 0.0
    high = 1.0
    share = 1.0
    for attempt in range(1 + _BISECTIONS):
        if _mix(cell, work, share, h, too_close) and _certified(cell, work, h):
            low = share
            if attempt == 0:
                break
        else:
            high = share
        share = 0.5 * (low + high)
    if low == 0.0:
        return STOPPED
    _mix(cell, work, low, h, too_close)
    for j in range(work.q.shape[0]):
        work.deceleration[0, j] = work.deceleration[1, j]
    return FOLLOWED if low == 1.0 else REDUCED


@lean_kernel
def _mix(cell: Cell, work: Workspace, share: float, h: float, together: bool) -> bool:
    """Candidate between the certified stop and the wanted velocities, and its own stop; False if that has no room."""
    for j in range(work.q.shape[0]):
        braked = work.candidate[2, j]
        work.candidate[0, j] = work.wanted[j] if share == 1.0 else braked + share * (work.wanted[j] - braked)
        work.candidate[1, j] = work.q[j] + 0.5 * h * (work.v[j] + work.candidate[0, j])
    if together:
        return stop_together(
            work.candidate[1],
            work.candidate[0],
            cell.lower,
            cell.upper,
            cell.acceleration,
            cell.limits.longest_step,
            work.deceleration[1],
        )
    for j in range(work.q.shape[0]):
        work.deceleration[1, j] = cell.acceleration[j]
    return True


@lean_kernel
def _note_active(work: Workspace) -> float:
    """List the limits and pairs that the new velocities meet; returns the largest violation of a row [rad/s]."""
    v = work.v
    count = 0
    for j in range(v.shape[0]):
        kind = NO_LIMIT
        if v[j] >= work.box_upper[j] - _ACTIVE:
            kind = work.binding[j, 1]
        elif v[j] <= work.box_lower[j] + _ACTIVE:
            kind = work.binding[j, 0]
        if kind != NO_LIMIT:
            work.active.code[count] = 4 * j + kind
            count += 1
    slack = 0.0
    for i in range(work.rows.used[0]):
        rate = 0.0
        for j in range(v.shape[0]):
            rate += work.rows.matrix[i, j] * v[j]
        slack = max(slack, work.rows.lower[i] - rate)
        if rate <= work.rows.lower[i] + _ACTIVE:
            work.active.code[count] = -1 - work.rows.pair[i]
            count += 1
    work.active.used[0] = count
    return slack
