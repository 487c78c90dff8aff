"""The load of an arm is identified from torques at rest."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.errors import RobotError
from q2r2_control.robot.load import MODEL, PENDANT, LoadReport, identify_load
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

# Added mass [kg], and its position in the frame of the tool's base, which is the flange [m].
ADDED, AT = 0.7, np.array([0.02, -0.03, 0.1])


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7_fri.yaml"))


def measured(robot: Robot, count: int, spread: float) -> tuple[Array, Array]:
    """Return postures (count, nv) [rad], and the torques (count, nv) [Nm] of an additional mass at the right tool."""
    random, true = np.random.default_rng(1), robot.model.copy()
    base = robot.model.frames[robot.model.getFrameId("right_hand_e_base")]
    true.appendBodyToJoint(base.parentJoint, pin.Inertia(ADDED, AT, np.zeros((3, 3))), base.placement)
    data = true.createData()
    postures = robot.home + random.uniform(-spread, spread, (count, robot.model.nv))
    mine = robot.model.createData()
    missing = [
        pin.computeGeneralizedGravity(true, data, q) - pin.computeGeneralizedGravity(robot.model, mine, q)
        for q in postures
    ]
    return postures, np.array(missing)


def test_an_additional_load_of_an_arm_is_identified_in_the_frame_of_the_flange(robot: Robot) -> None:
    right, left = (identify_load(robot, arm, *measured(robot, 8, 0.4), MODEL) for arm in ("right", "left"))
    masses = np.array([right.expected_kg, ADDED])
    centre = masses @ np.array([right.expected_centre_mm, 1e3 * AT]) / masses.sum()
    assert right.expected_kg == pytest.approx(0.983 + 2 * 0.038)
    assert right.identified_kg == pytest.approx(masses.sum())
    assert right.identified_centre_mm == pytest.approx(centre.tolist(), abs=0.1)
    assert right.residual_nm < 1e-6
    left.check()
    with pytest.raises(RobotError, match=r"the right arm carries 1\.76 kg at .* allowed: off by 0\.3 kg and 50 mm"):
        right.check()


def test_a_wrong_centre_of_mass_is_refused_even_if_the_mass_is_right() -> None:
    with pytest.raises(RobotError, match="60 mm away"):
        LoadReport("left", MODEL, 1.0, 1.0, [0.0, 60.0, 50.0], [0.0, 0.0, 50.0], 0.1).check()


def test_if_torques_are_compared_with_our_model_a_load_is_judged_only_if_some_load_fits_the_torques() -> None:
    heavy = 4.0, 1.0, [0.0, 0.0, 50.0], [0.0, 0.0, 50.0], 2.0
    LoadReport("left", MODEL, *heavy).check()
    with pytest.raises(
        RobotError, match=r"4\.00 kg at 0, 0, 50 mm; the pendant, if its load data are the model's, has 1\.00"
    ):
        LoadReport("left", PENDANT, *heavy).check()


@pytest.mark.parametrize(
    ("count", "spread", "told"),
    [
        pytest.param(7, 0.4, "7 postures: allowed: 8 or more", id="too few"),
        pytest.param(8, 0.0, "too alike", id="the same one"),
    ],
)
def test_postures_with_too_little_information_are_refused(robot: Robot, count: int, spread: float, told: str) -> None:
    with pytest.raises(RobotError, match=told):
        identify_load(robot, "left", *measured(robot, count, spread), MODEL)
