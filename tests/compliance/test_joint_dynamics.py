"""Compiled dynamics are Pinocchio's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.compliance.joint_dynamics import Dynamics, LinkInertias, inverse_dynamics
from q2r2_control.config.cell import load_config
from q2r2_control.control.geometry.kinematics import Placements, chain_of, place
from q2r2_control.robot.robot import Robot

SLIDING = """<robot name="crane"><link name="base"/>
<joint name="lift" type="prismatic"><parent link="base"/><child link="boom"/><origin xyz="0 0.1 0.2" rpy="0.3 0 0.1"/>
<axis xyz="0 0.6 0.8"/><limit lower="-1" upper="1" velocity="1" effort="10"/></joint>
<link name="boom"><inertial><origin xyz="0.1 0 0.2" rpy="0 0.4 0"/><mass value="3"/>
<inertia ixx="0.1" iyy="0.2" izz="0.15" ixy="0.01" ixz="0" iyz="-0.02"/></inertial></link>
<joint name="turn" type="revolute"><parent link="boom"/><child link="hook"/><origin xyz="0.5 0 0"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" velocity="1" effort="10"/></joint>
<link name="hook"><inertial><origin xyz="0 0 -0.3"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def _models() -> list[pin.Model]:
    cells = [Robot.from_config(load_config(Path("config") / f"{name}.yaml")) for name in ("dual_iiwa7", "dual_iiwa14")]
    return [*(cell.model for cell in cells), pin.buildModelFromXML(SLIDING)]


@pytest.mark.parametrize("model", _models(), ids=["iiwa 7", "iiwa 14", "a joint that slides"])
def test_torque_and_inertia_are_pinocchio_s(model: pin.Model) -> None:
    random, data, chain = np.random.default_rng(0), model.createData(), chain_of(model)
    bodies, placements, dynamics = LinkInertias.of(model), Placements.empty(chain), Dynamics.empty(chain)
    for _ in range(50):
        q, v, a = random.uniform(-2.0, 2.0, (3, model.nv))
        place(chain, q, placements)
        inverse_dynamics(chain, bodies, placements, v, a, dynamics)
        M = np.triu(pin.crba(model, data, q))
        np.testing.assert_allclose(dynamics.tau, pin.rnea(model, data, q, v, a), atol=1e-11)
        np.testing.assert_allclose(dynamics.M, M + np.triu(M, 1).T, atol=1e-11)


def test_another_body_counts_from_the_next_call_on() -> None:
    model = pin.buildModelFromXML(SLIDING)
    chain = chain_of(model)
    bodies, placements, dynamics = LinkInertias.of(model), Placements.empty(chain), Dynamics.empty(chain)
    held = pin.Inertia.FromSphere(2.0, 0.1)
    model.inertias[2] = model.inertias[2] + held
    bodies.put(2, model.inertias[2])
    q, zero = np.array([0.1, 0.7]), np.zeros(2)
    place(chain, q, placements)
    inverse_dynamics(chain, bodies, placements, zero, zero, dynamics)
    gravity = pin.computeGeneralizedGravity(model, model.createData(), q)
    np.testing.assert_allclose(dynamics.tau, gravity, atol=1e-12)
