from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.control.geometry.kinematics import Placements, chain_of, place
from q2r2_control.errors import RobotError
from q2r2_control.types import Array
from tests.control.cells import NAMES, cell, random_posture


def _assert_equals_pinocchio(model: pin.Model, postures: list[Array]) -> None:
    chain, data = chain_of(model), model.createData()
    placements = Placements.empty(chain)
    for q in postures:
        place(chain, q, placements)
        pin.computeJointJacobians(model, data, q)
        for i in range(1, model.njoints):
            np.testing.assert_allclose(placements.rotation[i], data.oMi[i].rotation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(placements.translation[i], data.oMi[i].translation, rtol=0, atol=1e-12)
            column = np.reshape(pin.getJointJacobian(model, data, i, pin.LOCAL_WORLD_ALIGNED), (6, -1))[:, i - 1]
            axis = column[:3] if chain.prismatic[i] else column[3:]
            np.testing.assert_allclose(placements.axis[i], axis, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_every_joint_frame_is_where_pinocchio_puts_it(name: str) -> None:
    robot, random = cell(name).robot, np.random.default_rng(3)
    beyond = 1.5 * robot.position_upper
    _assert_equals_pinocchio(robot.model, [np.zeros(14), beyond, *(random_posture(robot, random) for _ in range(20))])


def _model(*joints: object) -> pin.Model:
    """Return a chain of joints, each with an offset and a rotation relative to the joint before."""
    model, parent = pin.Model(), 0
    for number, joint in enumerate(joints):
        offset = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.4, 0.5), np.array([0.1, 0.2, -0.3]))
        parent = model.addJoint(parent, joint, offset, f"joint_{number}")
    return model


def test_prismatic_joints_and_oblique_axes_are_where_pinocchio_puts_them() -> None:
    oblique = np.array([1.0, -2.0, 0.5]) / np.linalg.norm([1.0, -2.0, 0.5])
    turned, slid = pin.JointModelRevoluteUnaligned(oblique), pin.JointModelPrismaticUnaligned(oblique)
    model = _model(pin.JointModelRZ(), pin.JointModelPX(), turned, slid, pin.JointModelRY())
    random = np.random.default_rng(4)
    _assert_equals_pinocchio(model, [random.uniform(-2, 2, 5) for _ in range(20)])
    assert chain_of(model).prismatic.tolist() == [0, 0, 1, 0, 1, 0]


UNSUPPORTED: dict[str, Callable[[], object]] = {
    "a ball joint": pin.JointModelSpherical,
    "an endless joint": pin.JointModelRUBX,
    "a fine screw": lambda: pin.JointModelHX(0.2),
    "a coarse screw": lambda: pin.JointModelHX(1.5),
}


@pytest.mark.parametrize("joint", UNSUPPORTED.values(), ids=UNSUPPORTED.keys())
def test_the_error_about_a_joint_that_is_neither_revolute_nor_prismatic_names_the_joint(
    joint: Callable[[], object],
) -> None:
    with pytest.raises(RobotError, match=r"joint_1.*revolute and prismatic"):
        chain_of(_model(pin.JointModelRZ(), joint()))
