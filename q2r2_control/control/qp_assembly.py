"""One tick's problem: the cost of all tasks, the box of next velocities and the separation rows, compiled."""

from __future__ import annotations

from q2r2_control.control.cholesky import factorise, substitute
from q2r2_control.control.jit import KernelPointer, kernel, pointee
from q2r2_control.control.kernel_model import KernelData, KernelModel
from q2r2_control.control.safety.joint_limits import next_velocity_box
from q2r2_control.control.safety.safety_data import SafetyData
from q2r2_control.control.safety.separation_rows import write_separation_rows
from q2r2_control.control.targets import update_targets
from q2r2_control.control.tasks.frame import (
    accumulate_stretch_damping,
    accumulate_tool_cost,
    tool_jacobian,
    wanted_twist,
)
from q2r2_control.control.tasks.posture import (
    accumulate_hold_cost,
    accumulate_posture_cost,
    factor_of_tools,
    project_to_nullspace,
    pull_to_posture,
)
from q2r2_control.control.tasks.task_data import TaskData, TaskTargets


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


@kernel
def assemble(
    model_pointer: KernelPointer, targets_pointer: KernelPointer, data_pointer: KernelPointer, h: float, tick: float
) -> tuple[bool, bool, bool]:
    """Cost, rows and box of a step of ``h`` [s] from an observed reference.

    ``tick`` [s]: the step is the first of such a tick, which begins with what was offered as targets; below 0: it is
    another one. Returns whether all targets were usable, whether all joints are within their limits, and what
    :func:`find_minimum` says.
    """
    model, targets, data = pointee(model_pointer), pointee(targets_pointer), pointee(data_pointer)
    state, tasks = data.safety.state, data.tasks
    usable = True
    if tick >= 0.0:
        usable = update_targets(targets, state.q, state.v, tick)
        state.a[:] = 0.0
    tasks.H[:] = 0.0
    tasks.g[:] = 0.0
    tasks.J[:] = 0.0
    pull_to_posture(model.tasks, tasks, targets, state.q)
    for i in range(targets.follows.shape[0]):
        if targets.follows[i] == 1:
            _follow(model, data, targets, i)
        else:
            accumulate_hold_cost(tasks, targets, i, state.q)
    factor_of_tools(tasks.J, tasks.tools_factor)
    project_to_nullspace(tasks.J, tasks.tools_factor, tasks.tools_moved, tasks.posture)
    accumulate_posture_cost(model.tasks, tasks)
    write_separation_rows(model.safety, data.safety, h)
    inside = next_velocity_box(model.safety.limits, state.q, state.v, h, data.safety.box)
    return usable, inside, find_minimum(data.safety, tasks)


@kernel
def _follow(model: KernelModel, data: KernelData, targets: TaskTargets, i: int) -> None:
    """Cost of tool ``i`` on the way to its target."""
    tasks, J = data.tasks, data.tasks.J[6 * i : 6 * i + 6]
    tool_jacobian(model.tasks.chain, tasks.placements, model.tasks.tools, i, tasks.translation[i], J)
    wanted_twist(model.tasks.motion, tasks, targets, i)
    accumulate_tool_cost(J, tasks.twist[i], model.tasks.priority.weight[i], tasks.H, tasks.g)
    accumulate_stretch_damping(model.tasks, tasks, i)
