"""One tick's problem: the cost of all tasks, the box of next velocities and the separation rows, compiled."""

from __future__ import annotations

from q2r2_control.control.jit import KernelPointer, kernel, pointee
from q2r2_control.control.kernel_data import KernelData
from q2r2_control.control.kernel_model import KernelModel
from q2r2_control.control.safety.joint_limits import next_velocity_box
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
from q2r2_control.control.tasks.task_data import TaskTargets
from q2r2_control.control.unconstrained import find_minimum


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
