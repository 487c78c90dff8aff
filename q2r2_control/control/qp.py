"""The QP of a step: built from tasks, box and separation rows by compiled kernels, and solved where a bound matters.

    minimise    1/2 v' H v + g' v + 1/2 sum_i s_i^2 / rho_i,    rho_i = SOFTNESS a_i' H^-1 a_i,  a_i the i-th row
    subject to  lower <= v <= upper,    rows v + s >= rows_lower,    s >= 0

The box is never empty (joint_limits.py) and the rows are soft, so a solution always exists. Rows have unit norm, so
that a slack is a joint speed. H^-1 along a row is the cost's compliance to it. A row alone gives way by the part
SOFTNESS of what it corrects, however strong the cost. Where the cost's own minimum keeps box and rows it is the
solution, and no solver has to be asked.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from q2r2_control.control.cholesky import factorise, substitute
from q2r2_control.control.geometry.closest_points import dot
from q2r2_control.control.jit import kernel
from q2r2_control.control.kernel_model import KernelData
from q2r2_control.control.kernel_pointers import KernelPointer, pointee
from q2r2_control.control.safety.joint_limits import next_velocity_box
from q2r2_control.control.safety.separation_rows import write_separation_rows
from q2r2_control.control.targets import update_targets
from q2r2_control.control.tasks.built_in import write_task_cost
from q2r2_control.types import Array

SOFTNESS = 1e-5  # part of its correction by which a row gives way


@dataclass(slots=True)  # not frozen: that would cost a microsecond a tick
class QpProblem:
    """One tick's problem; arrays are valid until the next tick."""

    H: Array  # (nv, nv), symmetric positive definite
    g: Array  # (nv,)
    lower: Array  # (nv,) [rad/s]
    upper: Array  # (nv,) [rad/s]
    rows: Array  # (m, nv), unit rows
    rows_lower: Array  # (m,) [rad/s]
    minimum: Array | None = None  # (nv,) of the cost alone, if that keeps box and rows and so is the solution [rad/s]
    hard: int = 0  # how many of the last rows may not give way


@dataclass(slots=True)
class QpSolution:
    """The answer of a solver."""

    v: Array | None  # (nv,) [rad/s]; None: no solution
    solve_time: float  # the solver's own measure, 0 where none was asked [s]


class Solver(Protocol):
    """Solves a :class:`QpProblem`. An exception of it is a failed solve."""

    def solve(self, problem: QpProblem) -> QpSolution: ...


def row_softness(H: Array, rows: Array) -> Array:
    """rho_i = SOFTNESS a_i' H^-1 a_i of each of the ``rows`` (m, nv), (m,)."""
    compliance: Array = np.sum(rows * np.linalg.solve(H, rows.T).T, axis=1)
    return SOFTNESS * compliance


@kernel
def find_minimum(data_pointer: KernelPointer) -> bool:
    """Write -H^-1 g to ``tasks.minimum`` (nv,) [rad/s]; whether it is finite and within the box and all rows."""
    return _find_minimum(pointee(data_pointer))


@kernel
def _find_minimum(data: KernelData) -> bool:
    """:func:`find_minimum` as a part of :func:`assemble`: of kernels, only those that Python calls are optimised."""
    tasks, box, rows, minimum = data.tasks, data.safety.box, data.safety.rows, data.tasks.minimum
    nv = minimum.shape[0]
    for i in range(nv):
        for j in range(i, nv):
            tasks.factor[i, j] = tasks.H[i, j]
        minimum[i] = -tasks.g[i]
    if not factorise(tasks.factor):
        return False
    substitute(tasks.factor, minimum)
    for j in range(nv):
        # Written so that what is no number is outside.
        if not (box.lower[j] <= minimum[j] <= box.upper[j]):
            return False
    kept = True
    for row in range(rows.used[0]):
        kept &= dot(rows.matrix[row], minimum) >= rows.lower[row]
    return kept


@kernel
def assemble(
    model_pointer: KernelPointer, targets_pointer: KernelPointer, data_pointer: KernelPointer, h: float, tick: float
) -> tuple[bool, bool, bool]:
    """Cost, rows and box of a step of ``h`` [s] from an observed reference.

    ``tick`` [s]: of which it is the first step, with the targets that were offered; below 0: it is another one. Returns
    whether all targets were usable, whether all joints are within their limits, and what :func:`find_minimum` says.
    """
    model, targets, data = pointee(model_pointer), pointee(targets_pointer), pointee(data_pointer)
    state, usable = data.safety.state, True
    if tick >= 0.0:
        usable = update_targets(targets, state.q, state.v, tick)
        state.a[:] = 0.0
    write_task_cost(model.tasks, data.tasks, targets, state.q)
    write_separation_rows(model.safety, data.safety, h)
    inside = next_velocity_box(model.safety.limits, state.q, state.v, h, data.safety.box)
    return usable, inside, _find_minimum(data)
