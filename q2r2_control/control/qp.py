"""The QP of a step. Compiled kernels build it from the tasks, the velocity box and the separation rows.

    minimise    1/2 v' H v + g' v + 1/2 sum_i s_i^2 / rho_i,    rho_i = SOFTNESS a_i' H^-1 a_i,  a_i the i-th row
    subject to  lower <= v <= upper,    rows v + s >= rows_lower,    s >= 0

The box is never empty (joint_limits.py) and the rows are soft. A solution therefore always exists. Rows have unit norm,
so that a slack is a joint speed. If the minimum of the cost violates only row i, the share SOFTNESS of this violation
remains in the solution as slack. The factor a_i' H^-1 a_i in rho_i, which is the compliance of the cost along row i,
makes this true however large the weights of the cost are. If the minimum of the cost alone is within the box and
satisfies the rows, it is the solution, and no solver is called.
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

SOFTNESS = 1e-5  # If the minimum of the cost violates one row, this share of the violation remains in the solution.


@dataclass(slots=True)  # The class is not frozen, because a frozen class would cost a microsecond a tick.
class QpProblem:
    """The problem of one step, for nv joints.

        minimise    1/2 v' H v + g' v + 1/2 sum_i s_i^2 / rho_i
        subject to  lower <= v <= upper,    rows v + s >= rows_lower,    s >= 0,    s_i = 0 for a hard row

    The variables are the next joint velocities v [rad/s], and rho_i is :func:`row_softness`. Our own solver gets the
    controller's arrays, which are valid until the next step. Every other solver gets copies.

    Attributes:
        H: Matrix of the cost (nv, nv), symmetric and positive definite.
        g: Vector of the cost (nv,).
        lower: Least next velocities (nv,) [rad/s], from the limits of position, velocity and acceleration.
        upper: Greatest next velocities (nv,) [rad/s].
        rows: Left-hand sides (m, nv), of unit norm: first the rows of separation, then the soft constraints, then the
            hard constraints.
        rows_lower: Right-hand sides (m,) [rad/s].
        minimum: Minimum of the cost alone (nv,) [rad/s]; None if it is outside the box or breaks a row. If it is not
            None, it is the solution.
        hard: Number of hard rows, which come last.
    """

    H: Array
    g: Array
    lower: Array
    upper: Array
    rows: Array
    rows_lower: Array
    minimum: Array | None = None
    hard: int = 0


@dataclass(slots=True)
class QpSolution:
    """The answer of a solver.

    Attributes:
        v: Next joint velocities (nv,) [rad/s]; None if the solver found no solution.
        solve_time: Time that the solver reports [s]; 0 if it was not called.
    """

    v: Array | None
    solve_time: float


class Solver(Protocol):
    """An object that solves a :class:`QpProblem`: ``CartesianController(robot, settings, solver=MySolver())`` uses it.

    Nothing about its answer is trusted. An exception or an answer that is not usable counts as a failed solve, and the
    step executes the certified stop.
    """

    def solve(self, problem: QpProblem) -> QpSolution:
        """Solve ``problem`` as well as possible.

        Args:
            problem: The problem of this step.

        Returns:
            The solution. Its ``v`` is None if no solution was found.
        """
        ...


def row_softness(H: Array, rows: Array) -> Array:
    """Return rho_i = SOFTNESS a_i' H^-1 a_i (m,) of each of the ``rows`` (m, nv)."""
    compliance: Array = np.sum(rows * np.linalg.solve(H, rows.T).T, axis=1)
    return SOFTNESS * compliance


@kernel
def find_minimum(data_pointer: KernelPointer) -> bool:
    """Write -H^-1 g to ``tasks.minimum`` (nv,) [rad/s]. Return whether it is finite and within the box and all rows."""
    return _find_minimum(pointee(data_pointer))


@kernel
def _find_minimum(data: KernelData) -> bool:
    """Do the work of :func:`find_minimum`, also for :func:`assemble`.

    Python calls both :func:`find_minimum` and :func:`assemble`. This kernel is compiled as a part of them, because only
    kernels that Python calls are optimised (kernel_compiler.py).
    """
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
        # The comparison is written so that NaN counts as outside.
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
    """Write cost, rows and box of a step of ``h`` [s]. The distances at the reference have to be known already.

    In the first step of a tick, ``tick`` is the duration of the tick [s], and the offered poses become the targets. In
    later steps of the tick, ``tick`` is below 0. Returns whether all targets were usable, whether all joints are within
    their limits, and the result of :func:`find_minimum`.
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
