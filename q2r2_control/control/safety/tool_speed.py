"""Prove that no tool is faster than allowed in a step and in the full stop after it (compiled).

The speed of a tool's origin is |J(q) v|, with the linear part J of its Jacobian. J_j is the column of joint j, and
reach_j bounds how far the tool ever is from that joint's axis.

**Drift.** Take any subset of the joints, and fixed v_j with |v_j| <= m_j. While the speeds of the joints stay below
m_j, the sum of J_j v_j over this subset changes no faster than

    c(m) = sum_j reach_j m_j (m_j + 2 sum_(i before j) m_i)    [m/s^2],

because the joints before j turn its axis, and the joints behind j move the tool about this axis (separating_plane.py).

**Claim.** Let a step of h lead from (q, v) to (q+, v+) along a parabola, and a stop with decelerations d_j follow.
Joint j rests after T_j = |v+_j| / d_j, the last joint after T. Let P_k be the sum of J_j(q) v+_j over the joints that
rest no sooner than joint k, and with C = c(max(|v|, |v+|)) and c = c(|v+|) let

    M = max_k |P_k| + C h,
    B = M  if  c T <= M,  and else  (M + c T)^2 / (4 c T).

Then the tool is never faster than the greater of |J(q) v| and B. *Proof.* In the step v(t) lies between v and v+. Its
speed is at most (1 - t/h) |J v| + (t/h) (|J v+| + C h), and |J v+| is one of the |P_k|. In the stop, joint j has the
share s_j = 1 - t/T_j of its speed v+_j, and 0 after T_j. The longer T_j, the greater the share. With the joints sorted
by their shares, sum J_j s_j v+_j is a sum of the P_k with weights s_k - s_(k+1), none of them negative, which add up to
1 - t/T. Each P_k has changed by C h + c t at most. The speed is therefore at most (1 - t/T) (M + c t), whose maximum is
B. []

**Induction.** A step is taken only if B is within the limit. Then |J(q) v| is within the limit at the next step, and
during the whole known stop. If a tool is too fast at the start, it is braked until it is slow enough: until then, no
other motion can be proven.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from q2r2_control.control.geometry.closest_points import dot, size_of
from q2r2_control.control.geometry.kinematics import Chain, IntArray
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

if TYPE_CHECKING:
    from q2r2_control.control.safety.safety_data import SafetyData, SafetyModel

_SAME_TIME = 1e-9  # If the times until two joints rest differ by less than this share, both count as the same time.


class ToolLimits(NamedTuple):
    """The origins of all tools, and their largest speed."""

    joint: IntArray  # (n,) Number of the last joint that moves the tool.
    translation: Array  # (n, 3) Origin of the tool in the joint's frame [m].
    reach: Array  # (n, nv) Bound on the distance of the tool from each joint's axis [m]; 1 for a sliding joint.
    speed: float  # Speed that no tool exceeds; infinite without a limit [m/s].


def tool_limits_of(robot: Robot, chain: Chain, speed: float | None) -> ToolLimits:
    """Return the tools of a robot's arms with their limit ``speed`` [m/s], which is None if there is no limit."""
    n, nv = len(robot.arms), robot.model.nv
    speed = np.inf if speed is None else speed
    limits = ToolLimits(np.zeros(n, dtype=np.int64), np.zeros((n, 3)), np.zeros((n, nv)), float(speed))
    travel = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
    for i, arm in enumerate(robot.arms.values()):
        frame = robot.model.frames[arm.frame_id]
        limits.joint[i], limits.translation[i] = frame.parentJoint, frame.placement.translation
        farthest, joint = float(np.linalg.norm(frame.placement.translation)), int(frame.parentJoint)
        while joint != 0:  # See pairs_of, which does the same for bodies.
            slides = chain.prismatic[joint] == 1
            farthest += travel[joint - 1] if slides else 0.0
            limits.reach[i, joint - 1] = 1.0 if slides else farthest
            farthest += float(np.linalg.norm(chain.translation[joint]))
            joint = int(chain.parent[joint])
    return limits


class ToolSpeeds(NamedTuple):
    """Data that are written when a step is decided on."""

    held: IntArray  # (n,) 1 if the tool's speed limit has limited the step.
    origin: Array  # (3,) Buffer for the tool's origin in the world [m].
    columns: Array  # (nv, 3) Buffer for J_j v+_j of each joint [m/s].
    total: Array  # (3,) Buffer for a sum P_k [m/s].

    @classmethod
    def empty(cls, limits: ToolLimits) -> ToolSpeeds:
        n, nv = limits.reach.shape
        return cls(np.zeros(n, dtype=np.int64), np.zeros(3), np.zeros((nv, 3)), np.zeros(3))


@kernel
def keeps_tool_speed(model: SafetyModel, data: SafetyData, h: float) -> bool:
    """Return whether no tool is too fast in the step to ``data.candidate`` in ``h`` [s] and the full stop after it.

    ``data`` has to contain the placements at the reference. The proof assumes that no tool is too fast at the
    reference; otherwise the known stop is being executed.
    """
    limits = model.tools
    if limits.speed == np.inf:
        return True
    slow = True
    for i in range(limits.joint.shape[0]):
        if fastest_tool(model, data, i, h) > limits.speed:
            data.tools.held[i] = 1
            slow = False
    return slow


@kernel
def fastest_tool(model: SafetyModel, data: SafetyData, i: int, h: float) -> float:
    """Return the bound B of tool ``i`` [m/s], which the claim in the module's docstring defines.

    In the step and in the stop after it, the tool is never faster than the greater of B and its present speed.
    """
    parent, v_next, deceleration = model.collision.chain.parent, data.candidate.v, data.candidate.deceleration
    _write_columns(model, data, i)
    fastest, longest = 0.0, 0.0
    last = model.tools.joint[i]
    k = last
    while k != 0:
        rest = abs(v_next[k - 1]) / deceleration[k - 1]
        longest = max(longest, rest)
        data.tools.total[:] = 0.0
        j = last
        while j != 0:
            if abs(v_next[j - 1]) / deceleration[j - 1] >= rest * (1.0 - _SAME_TIME):
                for axis in range(3):
                    data.tools.total[axis] += data.tools.columns[j - 1, axis]
            j = parent[j]
        fastest = max(fastest, size_of(data.tools.total))
        k = parent[k]
    fastest += h * drift(model, i, data.state.v, v_next)
    gained = longest * drift(model, i, v_next, v_next)
    return fastest if gained <= fastest else (fastest + gained) ** 2 / (4.0 * gained)


@kernel
def drift(model: SafetyModel, i: int, v: Array, v_next: Array) -> float:
    """Return the rate c of the module's docstring for tool ``i`` [m/s^2].

    The velocity of each joint lies between ``v`` (nv,) and ``v_next`` (nv,).
    """
    parent, total = model.collision.chain.parent, 0.0
    j = model.tools.joint[i]
    while j != 0:
        before = 0.0
        k = parent[j]
        while k != 0:
            before += _faster(v, v_next, k)
            k = parent[k]
        speed = _faster(v, v_next, j)
        total += model.tools.reach[i, j - 1] * speed * (speed + 2.0 * before)
        j = parent[j]
    return total


@inlined_kernel
def _faster(v: Array, v_next: Array, joint: int) -> float:
    return max(abs(v[joint - 1]), abs(v_next[joint - 1]))


@kernel
def _write_columns(model: SafetyModel, data: SafetyData, i: int) -> None:
    """Write J_j v+_j of all joints that move tool ``i``, at the reference."""
    limits, chain, placements = model.tools, model.collision.chain, data.collision.placements
    origin, columns = data.tools.origin, data.tools.columns
    j = limits.joint[i]
    for row in range(3):
        along = dot(placements.rotation[j, row], limits.translation[i])
        origin[row] = placements.translation[j, row] + along
    while j != 0:
        axis, rate, column = placements.axis[j], data.candidate.v[j - 1], columns[j - 1]
        if chain.prismatic[j] == 1:
            for row in range(3):
                column[row] = rate * axis[row]
        else:
            x, y, z = (
                origin[0] - placements.translation[j, 0],
                origin[1] - placements.translation[j, 1],
                origin[2] - placements.translation[j, 2],
            )
            column[0] = rate * (axis[1] * z - axis[2] * y)
            column[1] = rate * (axis[2] * x - axis[0] * z)
            column[2] = rate * (axis[0] * y - axis[1] * x)
        j = chain.parent[j]
