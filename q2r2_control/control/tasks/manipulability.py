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

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.kinematics import Chain, Placements
from q2r2_control.control.jit import lean_kernel
from q2r2_control.control.tasks.frame import ROTATION_LENGTH
from q2r2_control.types import Array

_DAMPING = 1e-3  # least singular value that counts


class ManipulabilityScratch(NamedTuple):
    """Arrays that :func:`manipulability_gradient` writes."""

    gram: Array  # (6, 6)
    weights: Array  # (6, nv) (J J')^-1 J
    gradient: Array  # (nv,)

    @classmethod
    def empty(cls, nv: int) -> ManipulabilityScratch:
        return cls(np.zeros((6, 6)), np.zeros((6, nv)), np.zeros(nv))


@lean_kernel
def add_manipulability(
    chain: Chain,
    placements: Placements,
    joint: int,
    J: Array,
    gain: float,
    fastest: float,
    scratch: ManipulabilityScratch,
    posture: Array,
) -> None:
    """Add ``gain`` times the gradient of log m to ``posture`` (nv,) [rad/s], no joint by more than ``fastest``.

    ``J`` (6, nv) is the Jacobian of the tool that ``joint`` carries.
    """
    manipulability_gradient(chain, placements, joint, J, scratch)
    largest = 0.0
    for j in range(posture.shape[0]):
        largest = max(largest, abs(scratch.gradient[j]))
    # Scaled as a whole: clipped joint by joint it would no longer be a direction in which m rises.
    factor = min(gain, fastest / largest) if largest > 0.0 else 0.0
    for j in range(posture.shape[0]):
        posture[j] += factor * scratch.gradient[j]


@lean_kernel
def manipulability_gradient(
    chain: Chain, placements: Placements, joint: int, J: Array, scratch: ManipulabilityScratch
) -> None:
    """Gradient of log m into ``scratch.gradient`` (nv,) [1/rad] for the tool that ``joint`` carries."""
    _weigh(chain, joint, J, scratch)
    gradient, weights = scratch.gradient, scratch.weights
    gradient[:] = 0.0
    square = ROTATION_LENGTH * ROTATION_LENGTH
    far = joint
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


@lean_kernel
def _weigh(chain: Chain, joint: int, J: Array, scratch: ManipulabilityScratch) -> None:
    """(J J')^-1 J into ``scratch.weights`` by Cholesky, the angular rows divided by the length they carry twice."""
    gram, weights = scratch.gram, scratch.weights
    for i in range(6):
        for k in range(i + 1):
            gram[i, k] = 0.0
            far = joint
            while far != 0:
                gram[i, k] += _row_scale(i) * J[i, far - 1] * _row_scale(k) * J[k, far - 1]
                far = chain.parent[far]
        gram[i, i] += _DAMPING * _DAMPING
    for i in range(6):
        for k in range(i + 1):
            total = gram[i, k]
            for m in range(k):
                total -= gram[i, m] * gram[k, m]
            gram[i, k] = np.sqrt(total) if i == k else total / gram[k, k]
    far = joint
    while far != 0:
        j = far - 1
        for i in range(6):
            total = _row_scale(i) * J[i, j]
            for k in range(i):
                total -= gram[i, k] * weights[k, j]
            weights[i, j] = total / gram[i, i]
        for i in range(5, -1, -1):
            total = weights[i, j]
            for k in range(i + 1, 6):
                total -= gram[k, i] * weights[k, j]
            weights[i, j] = total / gram[i, i]
        for i in range(3, 6):
            weights[i, j] /= ROTATION_LENGTH
        far = chain.parent[far]


@lean_kernel
def _row_scale(row: int) -> float:
    return 1.0 if row < 3 else ROTATION_LENGTH
