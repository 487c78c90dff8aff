from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.robot.description import load_description
from q2r2_control.robot.pinocchio_models import lock_joints, resting_position


@pytest.mark.parametrize("model", ["iiwa7", "example-robot-data:tiago_dual", "example-robot-data:talos"])
def test_with_locked_joints_every_link_is_where_pinocchio_puts_it_at_the_same_positions(model: str) -> None:
    urdf = load_description(model).urdf
    whole = pin.buildModelFromXML(ET.tostring(urdf, encoding="unicode"))
    random = np.random.default_rng(0)
    q = random.uniform(np.maximum(whole.lowerPositionLimit, -7), np.minimum(whole.upperPositionLimit, 7))
    names = list(whole.names)[1:]
    positions = {name: float(q[whole.joints[whole.getJointId(name)].idx_q]) for name in names}
    kept = {name for name in positions if random.random() < 0.3}
    lock_joints(urdf, kept, positions)
    locked = pin.buildModelFromXML(ET.tostring(urdf, encoding="unicode"))
    assert set(locked.names) - {"universe"} == kept
    posture = np.array([positions[name] for name in list(locked.names)[1:]])
    for built, at in ((whole, q), (locked, posture)):
        built.data = built.createData()
        pin.framesForwardKinematics(built, built.data, at)
    for link in urdf.findall("link"):
        frames = [
            built.data.oMf[built.getFrameId(link.get("name", ""), pin.FrameType.BODY)].homogeneous
            for built in (whole, locked)
        ]
        np.testing.assert_allclose(frames[0], frames[1], atol=1e-6)


@pytest.mark.parametrize(("lower", "upper", "rest"), [(-1, 1, 0.0), (0.5, 1, 0.5), (-2, -1, -1.0)])
def test_the_resting_position_of_a_joint_is_as_near_to_zero_as_its_limits_allow(
    lower: float, upper: float, rest: float
) -> None:
    joint = ET.fromstring(f'<joint name="j" type="revolute"><limit lower="{lower}" upper="{upper}"/></joint>')
    assert resting_position(joint) == rest
