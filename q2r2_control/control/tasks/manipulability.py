"""The direction in joint space that makes an arm more able to move in every direction, compiled.

Manipulability is m = sqrt(det(J J')) (Yoshikawa, Int. J. Robotics Research 4(2), 1985), J (6, n) the tool's Jacobian
with its angular rows times the length that makes a radian comparable to a metre. Its logarithm has the gradient

    d log m / dq_k = trace((J J')^-1 (dJ/dq_k) J'),

and of the Jacobian's column of joint j, with z_k the axis of a revolute joint k,

    dJ_j/dq_k = z_k x J_j  (linear and angular part)  if joint k carries joint j or is joint j,
    dJ_j/dq_k = z_j x J_k  (linear part)              if joint j carries joint k.

J J' gets a little damping on its diagonal, so that the gradient stays finite where m vanishes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from q2r2_control.control.cholesky import factorise, substitute
from q2r2_control.control.jit import kernel
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.types import Array

if TYPE_CHECKING:  # these are made of what this module defines
    from q2r2_control.control.tasks.task_data import TaskData
    from q2r2_control.control.tasks.task_model import TaskModel

_DAMPING = 1e-3  # least singular value that counts


class ManipulabilityScratch(NamedTuple):
    """Arrays of the manipulability's gradient."""

    gram: Array  # (6, 6)
    weights: Array  # (6, nv) (J J')^-1 J
    gradient: Array  # (nv,)

    @classmethod
    def empty(cls, nv: int) -> ManipulabilityScratch:
        return cls(np.zeros((6, 6)), np.zeros((6, nv)), np.zeros(nv))


@kernel
def pull_to_manipulability(model: TaskModel, data: TaskData, i: int) -> None:
    """Add the gradient of arm ``i``'s log m times the gain to ``data.posture``, no joint beyond the posture's speed."""
    manipulability_gradient(model, data, i)
    posture, gradient = data.posture, data.manipulability.gradient
    largest = 0.0
    for j in range(posture.shape[0]):
        largest = max(largest, abs(gradient[j]))
    # Scaled as a whole: clipped joint by joint it would no longer be a direction in which m rises.
    factor = min(model.manipulability_gain, model.posture.speed / largest) if largest > 0.0 else 0.0
    for j in range(posture.shape[0]):
        posture[j] += factor * gradient[j]


@kernel
def manipulability_gradient(model: TaskModel, data: TaskData, i: int) -> None:
    """Gradient of log m of arm ``i`` into ``data.manipulability.gradient`` (nv,) [1/rad]."""
    _weigh(model, data, i)
    chain, placements, J = model.chain, data.placements, data.J[6 * i : 6 * i + 6]
    gradient, weights = data.manipulability.gradient, data.manipulability.weights
    gradient[:] = 0.0
    square = ROTATION_LENGTH * ROTATION_LENGTH
    far = model.tools.joint[i]
    while far != 0:
        j = far - 1
        near = far
        while near != 0:
            k = near - 1
            if chain.prismatic[near] == 0:
                x, y, z = placements.axis[near, 0], placements.axis[near, 1], placements.axis[near, 2]
                for part in range(2):
                    row = 3 * part
                    a, b, c = J[row, j], J[row + 1, j], J[row + 2, j]
                    scale = 1.0 if part == 0 else square
                    dx, dy, dz = scale * (y * c - z * b), scale * (z * a - x * c), scale * (x * b - y * a)
                    gradient[k] += weights[row, j] * dx + weights[row + 1, j] * dy + weights[row + 2, j] * dz
                    if part == 0 and near != far:
                        gradient[j] += weights[0, k] * dx + weights[1, k] * dy + weights[2, k] * dz
            near = chain.parent[near]
        far = chain.parent[far]


@kernel
def _weigh(model: TaskModel, data: TaskData, i: int) -> None:
    """(J J')^-1 J into the scratch's weights by Cholesky, the angular rows divided by the length they carry twice."""
    chain, joint, J = model.chain, model.tools.joint[i], data.J[6 * i : 6 * i + 6]
    gram, weights = data.manipulability.gram, data.manipulability.weights
    for row in range(6):
        for k in range(row, 6):
            gram[row, k] = 0.0
            far = joint
            while far != 0:
                gram[row, k] += _row_scale(row) * J[row, far - 1] * _row_scale(k) * J[k, far - 1]
                far = chain.parent[far]
        gram[row, row] += _DAMPING * _DAMPING
    factorise(gram)  # positive definite for any finite J
    far = joint
    while far != 0:
        j = far - 1
        for row in range(6):
            weights[row, j] = _row_scale(row) * J[row, j]
        substitute(gram, weights[:, j])
        for row in range(3, 6):
            weights[row, j] /= ROTATION_LENGTH
        far = chain.parent[far]


@kernel
def _row_scale(row: int) -> float:
    return 1.0 if row < 3 else ROTATION_LENGTH
