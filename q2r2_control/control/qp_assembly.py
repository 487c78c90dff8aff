"""One tick's problem from the reference's state: observe the geometry, then write costs and box, compiled."""

from __future__ import annotations

import numpy as np

from q2r2_control.control.geometry.closest_points import clamp
from q2r2_control.control.geometry.collision import pose_bodies
from q2r2_control.control.geometry.kinematics import place
from q2r2_control.control.jit import Held, kernel, lean_kernel
from q2r2_control.control.kernel_data import Cell, Goals, Workspace
from q2r2_control.control.safety.joint_limits import next_velocity_box
from q2r2_control.control.safety.separation_rows import separation_rows
from q2r2_control.control.safety.velocity_bounds import find_pace
from q2r2_control.control.tasks.frame import (
    add_stretch_damping,
    add_tool_task,
    project_to_nullspace,
    tool_jacobian,
    tool_pose,
    wanted_twist,
)
from q2r2_control.control.tasks.manipulability import add_manipulability
from q2r2_control.control.tasks.priority import tool_speed
from q2r2_control.control.tasks.swivel import turn_elbows, write_rows

# A held arm is not pushed about by the other one's task, but may give way to recover separation.
_HOLD_WEIGHT = 10.0
_HOLD_GAIN = 4.0  # [1/s]


@lean_kernel
def observe(cell: Cell, work: Workspace) -> int:
    """Where everything is at the reference: tool poses, distances and separation rows. Returns the closest pair."""
    place(cell.chain, work.q, work.placements)
    pose_bodies(cell.bodies, work.placements, work.posed)
    find_pace(cell.chain, work.placements, cell.bodies, work.posed, work.v, work.pace)
    for i in range(cell.tools.joint.shape[0]):
        tool_pose(work.placements, cell.tools, i, work.rotation[i], work.translation[i])
    closest = separation_rows(
        cell.chain,
        work.placements,
        cell.bodies,
        work.posed,
        cell.pairs,
        work.pace,
        work.v,
        cell.acceleration,
        cell.limits.longest_step,
        cell.approach,
        work.distance,
        work.contact,
        work.rows,
    )
    for i in range(work.rows.used[0]):
        square = 0.0
        for j in range(work.q.shape[0]):
            square += work.rows.matrix[i, j] ** 2
        size = np.sqrt(square)
        for j in range(work.q.shape[0]):
            work.rows.matrix[i, j] /= size
        work.rows.lower[i] /= size
    return closest


@kernel
def assemble(held_cell: Held, held_goals: Held, held_work: Held, h: float) -> bool:
    """Costs and box for a step of ``h``; needs :func:`observe` first. False where a joint is outside its limits."""
    cell, goals, work = held_cell.value, held_goals.value, held_work.value
    q = work.q
    nv = q.shape[0]
    work.H[:] = 0.0
    work.g[:] = 0.0
    work.J[:] = 0.0
    pull = cell.limits.posture_gain
    fastest = cell.limits.posture_speed
    for j in range(nv):
        work.posture[j] = clamp(pull * (goals.posture[j] - q[j]), -fastest, fastest)
    for i in range(cell.tools.joint.shape[0]):
        if goals.follows[i] == 1:
            _follow(cell, goals, i, work)
        else:
            _hold(cell, goals, i, work)
    project_to_nullspace(work.J, work.posture)
    if cell.limits.swivels == 1:
        write_rows(cell.chain, work.placements, cell.swivels, goals.follows, fastest, work.swivel)
        project_to_nullspace(work.J, work.swivel.free)
        turn_elbows(cell.tools.member, fastest, work.swivel, work.posture)
    for j in range(nv):
        weight = cell.priority.posture_weight[j]
        work.H[j, j] += weight
        work.g[j] -= weight * work.posture[j]
    return next_velocity_box(
        q,
        work.v,
        cell.lower,
        cell.upper,
        cell.velocity,
        cell.acceleration,
        h,
        cell.limits.longest_step,
        cell.limits.return_speed,
        work.box_lower,
        work.box_upper,
        work.binding,
    )


@kernel
def _follow(cell: Cell, goals: Goals, i: int, work: Workspace) -> None:
    weight = cell.priority.weight[i]
    speed = tool_speed(
        i,
        work.distance,
        cell.pair_arm,
        goals.follows,
        cell.priority,
        cell.approach.stop_distance,
        cell.limits.contact_speed,
        cell.motion.full_speed[0],
        cell.limits.full_at,
    )
    J = work.J[6 * i : 6 * i + 6]
    tool_jacobian(cell.chain, work.placements, cell.tools, i, work.translation[i], J)
    wanted_twist(
        work.rotation[i],
        work.translation[i],
        goals.rotation[i],
        goals.translation[i],
        goals.feed_forward[i],
        cell.motion,
        speed,
        work.twist[i],
        work.feedback,
        work.contact.local,
    )
    add_tool_task(J, work.twist[i], weight, work.H, work.g)
    add_stretch_damping(
        cell.chain, work.placements, cell.tools.joint[i], J, work.feedback, cell.motion.stretch_gain, weight, work.H
    )
    if cell.limits.manipulability_gain > 0.0:
        add_manipulability(
            cell.chain,
            work.placements,
            cell.tools.joint[i],
            J,
            cell.limits.manipulability_gain,
            cell.limits.posture_speed,
            work.manipulability,
            work.posture,
        )


@lean_kernel
def _hold(cell: Cell, goals: Goals, i: int, work: Workspace) -> None:
    """Joints of a held arm return to where they were latched; the posture pull does not move them."""
    for j in range(work.q.shape[0]):
        if cell.tools.member[i, j] == 1.0:
            work.H[j, j] += _HOLD_WEIGHT
            work.g[j] -= _HOLD_WEIGHT * _HOLD_GAIN * (goals.hold[j] - work.q[j])
            work.posture[j] = 0.0
