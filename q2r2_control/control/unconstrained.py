"""The minimum of a tick's cost without its bounds, compiled: where it keeps them all, it is the solution of the QP.

A point that minimises a strictly convex cost over all velocities minimises it over those that are allowed if it is one
of them. Away from limits and from other bodies that holds at nearly every tick, and to look takes a tenth of the time
that a solver takes to begin.
"""

from __future__ import annotations

from q2r2_control.control.cholesky import factorise, substitute
from q2r2_control.control.jit import KernelPointer, kernel, pointee
from q2r2_control.control.kernel_data import KernelData
from q2r2_control.control.safety.safety_data import SafetyData
from q2r2_control.control.tasks.task_data import TaskData


@kernel
def find_minimum(safety: SafetyData, tasks: TaskData) -> bool:
    """Write -H^-1 g to ``tasks.minimum`` (nv,) [rad/s]; whether it is finite and within the box and all rows."""
    box, rows, minimum = safety.box, safety.rows, tasks.minimum
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
    for row in range(rows.used[0]):
        rate = 0.0
        for j in range(nv):
            rate += rows.matrix[row, j] * minimum[j]
        if not rate >= rows.lower[row]:
            return False
    return True


@kernel
def find_minimum_anew(data_pointer: KernelPointer) -> bool:
    """:func:`find_minimum`, after the cost has been changed from outside of the kernels."""
    data: KernelData = pointee(data_pointer)
    return find_minimum(data.safety, data.tasks)
