"""Write the cost of a tool that follows its target, as H and g of  1/2 v' H v + g' v (compiled).

The cost of each arm that follows a target is  |J v - u|^2_W + v' M v  with the wanted twist u of the tool. The weights
are W = diag(1, 1, 1, l^2, l^2, l^2), where the length l makes a radian comparable to a metre, times the weights of the
settings. The settings have weights along the world's axes, and about the tool's own axes. If the weight of an axis is
small, the posture may move the tool along or about this axis.

**Damping M.** If an arm is stretched out towards an unreachable target, the gradient of the reach with respect to the
elbow angle theta vanishes like L theta, with the arm's length L. Under a wanted speed s and a damping mu, the loop near
that posture therefore has the gain L s / mu. Without damping this gain is unbounded. Together with bounded
accelerations, it causes a limit cycle. In general the wanted velocity s adds the geometric stiffness
E_ij = s' d2x / dq_i dq_j. Only the negative part of E, the pull outwards, needs damping. The pull inwards drives the
arm away from the singular posture, as it should. The damping of joint i is mu_i = (d_i + sum_j min(|E_ij|, d_i)) / k
with d_i = max(0, -E_ii) and the setting k. If an arm is pulled straight, |E_ij| <= d_i. By Gershgorin's theorem the
gain is then at most k. M vanishes at the target.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.geometry.closest_points import dot, size_of
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements
from q2r2_control.control.jit import kernel
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

if TYPE_CHECKING:
    from q2r2_control.control.targets import TaskTargets
    from q2r2_control.control.tasks.built_in import TaskData, TaskModel


class Tools(NamedTuple):
    """The tool frame of each arm."""

    joint: IntArray  # (n,) Number of the last joint that moves the tool.
    rotation: Array  # (n, 3, 3) Rotation in the joint's frame.
    translation: Array  # (n, 3) Position in the joint's frame [m].
    member: Array  # (n, nv) 1 if a joint moves the tool.


def tools_of(robot: Robot) -> Tools:
    """Return the tool frames of a robot's arms."""
    n, nv = len(robot.arms), robot.model.nv
    tools = Tools(np.zeros(n, dtype=np.int64), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((n, nv)))
    for i, arm in enumerate(robot.arms.values()):
        frame = robot.model.frames[arm.frame_id]
        tools.joint[i] = frame.parentJoint
        tools.rotation[i] = frame.placement.rotation
        tools.translation[i] = frame.placement.translation
        tools.member[i, arm.joints] = 1.0
    return tools


ROTATION_LENGTH = 0.3  # The length l that makes a radian comparable to a metre [m/rad].
# Greatest speed that the task wants, as a share of the tool's speed limit. The certificate needs the remaining share.
_SHARE_OF_LIMIT = 0.9


class Motion(NamedTuple):
    """How a tool approaches its target.

    Arrays (2,) have a linear and an angular value. All may change between ticks.
    """

    gain: Array  # (2,) [1/s]
    deceleration: Array  # (2,) [m/s^2, rad/s^2]
    full_speed: Array  # (2,) [m/s, rad/s]
    stretch_gain: Array  # (1,) The gain k of the damping M [1/s].
    weight: Array  # (6,) Weights of the error along the world's axes and about the tool's axes, 0 .. 1.


def motion_of(settings: ControllerSettings) -> Motion:
    """Return the gains, speeds and weights of ``settings`` as arrays for the kernels."""
    limit = np.inf if settings.tool_speed_limit is None else settings.tool_speed_limit
    return Motion(
        gain=np.array([settings.position_gain, settings.rotation_gain]),
        deceleration=np.array([settings.linear_deceleration, settings.angular_deceleration]),
        full_speed=np.array([min(settings.max_linear_speed, _SHARE_OF_LIMIT * limit), settings.max_angular_speed]),
        stretch_gain=np.array([settings.stretch_gain]),
        weight=np.array([*settings.position_weights, *settings.rotation_weights], dtype=np.float64),
    )


class FrameData(NamedTuple):
    """Data that are written at each tick."""

    twist: Array  # (n, 6) Wanted twist [m/s, rad/s].
    feedback: Array  # (n, 6) Part of the twist that comes from the tool's pose error [m/s, rad/s].
    turn: Array  # (3, 3) Buffer for the rotation from a tool to its target.

    @classmethod
    def empty(cls, n: int) -> FrameData:
        return cls(np.zeros((n, 6)), np.zeros((n, 6)), np.zeros((3, 3)))


@kernel
def accumulate_frame_cost(model: TaskModel, data: TaskData, targets: TaskTargets) -> None:
    """Add the cost of every tool that follows its target, and write its Jacobian."""
    data.J[:] = 0.0
    weight = model.motion.weight
    for i in range(targets.follows.shape[0]):
        if targets.follows[i] == 0:
            continue
        J, twist, feedback = data.J[6 * i : 6 * i + 6], data.frame.twist[i], data.frame.feedback[i]
        tool_jacobian(model.chain, data.placements, model.tools, i, data.translation[i], J)
        wanted_twist(model.motion, data, targets, i)
        if not weight[3] == weight[4] == weight[5]:
            for j in range(J.shape[1]):
                express_in(data.rotation[i], J[3:6, j])
            express_in(data.rotation[i], twist[3:6])
            express_in(data.rotation[i], feedback[3:6])
        accumulate_tool_cost(J, twist, weight, model.priority.arm[i], data.H, data.g)
        for k in range(6):
            feedback[k] *= weight[k]
        accumulate_stretch_damping(model, data, i)
        for k in range(6):
            for j in range(J.shape[1]):
                J[k, j] *= np.sqrt(weight[k])


@kernel
def tool_pose(placements: Placements, tools: Tools, i: int, rotation: Array, translation: Array) -> None:
    """Write the world pose of tool ``i`` into ``rotation`` (3, 3) and ``translation`` (3,)."""
    joint = tools.joint[i]
    for row in range(3):
        axes = placements.rotation[joint, row]
        translation[row] = placements.translation[joint, row] + dot(axes, tools.translation[i])
        for column in range(3):
            rotation[row, column] = dot(axes, tools.rotation[i, :, column])


@kernel
def tool_jacobian(chain: Chain, placements: Placements, tools: Tools, i: int, translation: Array, J: Array) -> None:
    """Write the Jacobian (6, nv) of tool ``i``: linear, then angular velocity in world axes at the tool's origin."""
    J[:] = 0.0
    joint = tools.joint[i]
    while joint != 0:
        axis = placements.axis[joint]
        j = joint - 1
        if chain.prismatic[joint] == 1:
            for k in range(3):
                J[k, j] = axis[k]
        else:
            origin = placements.translation[joint]
            x, y, z = translation[0] - origin[0], translation[1] - origin[1], translation[2] - origin[2]
            J[0, j] = axis[1] * z - axis[2] * y
            J[1, j] = axis[2] * x - axis[0] * z
            J[2, j] = axis[0] * y - axis[1] * x
            for k in range(3):
                J[3 + k, j] = axis[k]
        joint = chain.parent[joint]


@kernel
def express_in(rotation: Array, vector: Array) -> None:
    """Convert the ``vector`` (3,) in place from world axes to the axes of ``rotation`` (3, 3)."""
    x, y, z = vector[0], vector[1], vector[2]
    for k in range(3):
        vector[k] = rotation[0, k] * x + rotation[1, k] * y + rotation[2, k] * z


@kernel
def rotation_vector(R: Array, out: Array) -> None:
    """Write the rotation vector [rad] of a rotation matrix (3, 3), with its angle in [0, pi].

    The function of :mod:`q2r2_control.quaternions` takes a quaternion of Python floats, which kernels do not have.
    """
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        w = 1.0 + trace
        out[0], out[1], out[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i = 1 if R[1, 1] > R[0, 0] else 0
        if R[2, 2] > R[i, i]:
            i = 2
        j, k = (i + 1) % 3, (i + 2) % 3
        w = R[k, j] - R[j, k]
        sign = 1.0 if w >= 0.0 else -1.0
        w *= sign
        out[i] = sign * (1.0 + R[i, i] - R[j, j] - R[k, k])
        out[j] = sign * (R[j, i] + R[i, j])
        out[k] = sign * (R[k, i] + R[i, k])
    imaginary = size_of(out)
    factor = 2.0 * np.arctan2(imaginary, w) / imaginary if imaginary > 1e-12 else 2.0 / w
    for k in range(3):
        out[k] *= factor


@kernel
def times_transposed(A: Array, B: Array, product: Array) -> None:
    """Write A B' of two 3 by 3 matrices."""
    for i in range(3):
        for j in range(3):
            product[i, j] = dot(A[i], B[j])


@kernel
def approach_speed(error: float, gain: float, deceleration: float) -> float:
    """Return the wanted speed towards a target at the distance ``error`` (e): proportional to e near the target.

    Up to e0 = deceleration / gain^2 the speed is v = gain e. Farther away it is the speed from which a tool stops with
    constant deceleration, v = sqrt(2 deceleration e - (deceleration / gain)^2). Both formulas have the same value and
    slope at e0. A purely proportional law would need a deceleration of gain times v, which is too much for the joints
    at high speed.
    """
    if error * gain * gain <= deceleration:
        return gain * error
    return np.sqrt(2.0 * deceleration * error - (deceleration / gain) ** 2)


@kernel
def wanted_twist(motion: Motion, data: TaskData, targets: TaskTargets, i: int) -> None:
    """Write the wanted twist of tool ``i`` into ``data.frame``, and also the part of it that the pose error causes."""
    twist, feedback, feed_forward = data.frame.twist[i], data.frame.feedback[i], targets.feed_forward[i]
    times_transposed(targets.rotation[i], data.rotation[i], data.frame.turn)
    for k in range(3):
        twist[k] = targets.translation[i, k] - data.translation[i, k]
    rotation_vector(data.frame.turn, twist[3:6])
    for part in range(2):
        piece = twist[3 * part : 3 * part + 3]
        error, cap = size_of(piece), motion.full_speed[part]
        speed = min(approach_speed(error, motion.gain[part], motion.deceleration[part]), cap)
        scale = speed / error if error > 1e-12 else 1.0
        for k in range(3):
            feedback[3 * part + k] = scale * piece[k]
            piece[k] = feedback[3 * part + k] + feed_forward[3 * part + k]
        size = size_of(piece)
        if size > cap:
            for k in range(3):
                piece[k] *= cap / size


@kernel
def accumulate_tool_cost(J: Array, twist: Array, weight: Array, priority: float, H: Array, g: Array) -> None:
    """Add ``priority`` |J v - twist|^2_W of one arm to H (nv, nv) and g (nv,). ``weight`` (6,) is for the rows of J."""
    nv = g.shape[0]
    square = priority * ROTATION_LENGTH * ROTATION_LENGTH
    for i in range(nv):
        # Columns of zeros are left out. They belong to joints of other arms, which do not move this tool.
        if J[0, i] == J[1, i] == J[2, i] == J[3, i] == J[4, i] == J[5, i] == 0.0:
            continue
        for k in range(6):
            g[i] -= (priority if k < 3 else square) * weight[k] * J[k, i] * twist[k]
        for j in range(i + 1):
            linear = weight[0] * J[0, i] * J[0, j] + weight[1] * J[1, i] * J[1, j] + weight[2] * J[2, i] * J[2, j]
            angular = weight[3] * J[3, i] * J[3, j] + weight[4] * J[4, i] * J[4, j] + weight[5] * J[5, i] * J[5, j]
            both = priority * linear + square * angular
            H[i, j] += both
            if i != j:
                H[j, i] += both


@kernel
def accumulate_stretch_damping(model: TaskModel, data: TaskData, i: int) -> None:
    """Add the damping M of tool ``i``, with the arm's weight, to ``data.H``.

    For a joint k between the base and joint j, d2x / dq_k dq_j = z_k x J_j is the second derivative of the tool's
    position. The angular part has no such symmetric second derivative. It is replaced by a bound on its magnitude,
    because joint k turns J_j no faster than |z_k|.
    """
    chain, placements, H = model.chain, data.placements, data.H
    J, feedback = data.J[6 * i : 6 * i + 6], data.frame.feedback[i]
    turning = ROTATION_LENGTH * ROTATION_LENGTH * size_of(feedback[3:6])
    scale = model.priority.arm[i] / model.motion.stretch_gain[0]
    far = model.tools.joint[i]
    while far != 0:
        j = far - 1
        pull_j = max(0.0, -_stiffness(chain, placements, far, far, J, feedback))
        H[j, j] += scale * (turning + pull_j)
        near = chain.parent[far]
        while near != 0:
            k = near - 1
            pull_k = max(0.0, -_stiffness(chain, placements, near, near, J, feedback))
            coupling = abs(_stiffness(chain, placements, near, far, J, feedback))
            H[j, j] += scale * min(coupling, pull_j)
            H[k, k] += scale * min(coupling, pull_k)
            near = chain.parent[near]
        far = chain.parent[far]


@kernel
def _stiffness(chain: Chain, placements: Placements, near: int, far: int, J: Array, s: Array) -> float:
    """Return s' d2x / dq_near dq_far for the tool's position x: s' (z_near x J_far), or 0 if joint ``near`` slides."""
    if chain.prismatic[near] == 1:
        return 0.0
    x, y, z = placements.axis[near, 0], placements.axis[near, 1], placements.axis[near, 2]
    j = far - 1
    return s[0] * (y * J[2, j] - z * J[1, j]) + s[1] * (z * J[0, j] - x * J[2, j]) + s[2] * (x * J[1, j] - y * J[0, j])
