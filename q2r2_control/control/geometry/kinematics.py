"""Forward kinematics of a tree of one-axis joints (compiled). The results are equal to Pinocchio's results.

The roll-out of a stop needs the placements of the links at many configurations in each tick. Calls of Pinocchio would
take too long. For that reason this part of Pinocchio is written again here. A test compares it with Pinocchio for every
robot.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.control.jit import kernel
from q2r2_control.errors import RobotError
from q2r2_control.types import Array

IntArray = npt.NDArray[np.int64]

_ANY_MOTION = 1e-9  # A column of the Jacobian that is longer than this is a motion, and not only rounding.


class Chain(NamedTuple):
    """The tree of joints as arrays. Index 0 is the world, and joint i has the velocity index i - 1."""

    parent: IntArray  # (n,) Number of the parent joint.
    rotation: Array  # (n, 3, 3) Rotation of the joint's frame in the frame of the parent joint, if q is 0.
    translation: Array  # (n, 3) Position of the joint's frame in the frame of the parent joint, if q is 0 [m].
    axis: Array  # (n, 3) Unit axis in the joint's frame.
    prismatic: IntArray  # (n,) 1 if the joint slides.


class Placements(NamedTuple):
    """Poses of the joint frames in the world frame, written by :func:`place`."""

    rotation: Array  # (n, 3, 3)
    translation: Array  # (n, 3) [m]
    axis: Array  # (n, 3) Unit axis of each joint in the world frame.

    @classmethod
    def empty(cls, chain: Chain) -> Placements:
        n = len(chain.parent)
        return cls(np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, 3)))


def chain_of(model: pin.Model) -> Chain:
    """Return the joints of a Pinocchio model.

    Raises:
        RobotError: If a joint does not have exactly one position and one velocity, or if it is a screw.
    """
    axis = np.zeros((model.njoints, 3))
    prismatic = np.zeros(model.njoints, dtype=np.int64)
    data = model.createData()
    pin.computeJointJacobians(model, data, np.zeros(model.nq))
    for i in range(1, model.njoints):
        joint = model.joints[i]
        if joint.nq != 1 or joint.nv != 1 or joint.idx_v != i - 1:
            raise RobotError(f"joint {model.names[i]}: only one-axis revolute and prismatic joints are supported")
        # The Jacobian is reshaped, because Pinocchio's binding drops the column dimension of a model with one joint.
        column = np.reshape(pin.getJointJacobian(model, data, i, pin.LOCAL), (6, model.nv))[:, joint.idx_v]
        slides, turns = np.linalg.norm(column[:3]) > _ANY_MOTION, np.linalg.norm(column[3:]) > _ANY_MOTION
        if slides and turns:
            raise RobotError(f"joint {model.names[i]} is a screw; only revolute and prismatic joints are supported")
        prismatic[i] = int(slides)
        axis[i] = column[:3] if prismatic[i] else column[3:]
    return Chain(
        parent=np.array([model.parents[i] for i in range(model.njoints)], dtype=np.int64),
        rotation=np.array([placement.rotation for placement in model.jointPlacements]),
        translation=np.array([placement.translation for placement in model.jointPlacements]),
        axis=axis,
        prismatic=prismatic,
    )


@kernel
def place(chain: Chain, q: Array, placements: Placements) -> None:
    """Write the pose of every joint frame in the world frame at the posture ``q`` (nv,)."""
    for i in range(1, chain.parent.shape[0]):
        parent = chain.parent[i]
        x, y, z = chain.axis[i, 0], chain.axis[i, 1], chain.axis[i, 2]
        sine, versine = 0.0, 0.0
        if chain.prismatic[i] == 0:
            sine, versine = np.sin(q[i - 1]), 1.0 - np.cos(q[i - 1])
        # This is the formula of Rodrigues, I + sin K + (1 - cos) K^2.
        t00 = 1.0 - versine * (y * y + z * z)
        t01 = versine * x * y - sine * z
        t02 = versine * x * z + sine * y
        t10 = versine * x * y + sine * z
        t11 = 1.0 - versine * (x * x + z * z)
        t12 = versine * y * z - sine * x
        t20 = versine * x * z - sine * y
        t21 = versine * y * z + sine * x
        t22 = 1.0 - versine * (x * x + y * y)
        for row in range(3):
            r0, r1, r2 = 0.0, 0.0, 0.0
            moved = placements.translation[parent, row]
            for k in range(3):
                up = placements.rotation[parent, row, k]
                r0 += up * chain.rotation[i, k, 0]
                r1 += up * chain.rotation[i, k, 1]
                r2 += up * chain.rotation[i, k, 2]
                moved += up * chain.translation[i, k]
            placements.rotation[i, row, 0] = r0 * t00 + r1 * t10 + r2 * t20
            placements.rotation[i, row, 1] = r0 * t01 + r1 * t11 + r2 * t21
            placements.rotation[i, row, 2] = r0 * t02 + r1 * t12 + r2 * t22
            placements.axis[i, row] = r0 * x + r1 * y + r2 * z
            if chain.prismatic[i] == 1:
                moved += q[i - 1] * placements.axis[i, row]
            placements.translation[i, row] = moved
