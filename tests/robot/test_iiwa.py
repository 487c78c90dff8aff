"""robots/iiwa7 and robots/iiwa14 agree with their sources: lengths, masses, limits, rotors and capsules."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.robot.compose import compose
from q2r2_control.robot.description import load_description
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.robot.conftest import one_arm


@dataclass(frozen=True)
class DataSheet:
    """Figures of KUKA and of the public lbr_description for one robot."""

    lengths: tuple[float, ...]  # Lengths base-shoulder, shoulder-elbow, elbow-wrist, wrist-flange [m].
    masses: tuple[float, ...]  # Masses of links 0..7 [kg].
    velocity: tuple[float, ...]  # [deg/s]
    torque: tuple[float, ...]  # [Nm]
    acceleration: tuple[float, ...]  # Acceleration limits that Drake publishes [rad/s^2].
    rotor: tuple[float, ...]  # Inertia about the rotor's own axis [kg m^2].
    gear: tuple[float, ...]


SHEETS = {
    "iiwa7": DataSheet(
        (0.34, 0.4, 0.4, 0.126),
        (4.855658, 3.394011, 4.031991, 3.394011, 4.031989, 1.529239, 2.403626, 0.259474),
        (98, 98, 100, 130, 140, 180, 180),
        (176, 176, 110, 110, 110, 40, 40),
        (8.65, 5.44, 5.69, 11.01, 11.78, 13.76, 13.17),
        (7.17e-5, 1.737e-4, 1.266e-4, 7.10e-5, 5.44e-5, 5.48e-5, 5.44e-5),
        (160,) * 7,
    ),
    "iiwa14": DataSheet(
        (0.36, 0.42, 0.4, 0.126),
        (7.050378, 5.289529, 5.688888, 3.461245, 4.122995, 1.563756, 2.457878, 0.265331),
        (85, 85, 100, 75, 130, 135, 135),
        (320, 320, 176, 176, 110, 40, 40),
        (8.57, 8.57, 8.74, 11.36, 12.23, 15.72, 15.72),
        (1.321e-4,) * 5 + (4.54e-5,) * 2,
        (160, 160, 160, 160, 100, 160, 160),
    ),
}


@pytest.fixture(scope="module", params=list(SHEETS))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def robot(name: str) -> Robot:
    return Robot.from_config(one_arm(model=name))


def _posture(*degrees: float) -> Array:
    return np.radians(np.array(degrees, dtype=float))


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        pytest.param((0, 0, 0, 0, 0, 0, 0), lambda d: (0, 0, sum(d)), id="stretched upwards"),
        pytest.param((0, 90, 0, 0, 0, 0, 0), lambda d: (sum(d[1:]), 0, d[0]), id="A2 tips the whole arm forwards"),
        pytest.param((0, 0, 0, -90, 0, 0, 0), lambda d: (d[2] + d[3], 0, d[0] + d[1]), id="negative A4 bends forwards"),
        pytest.param((0, 0, 0, 0, 0, 90, 0), lambda d: (d[3], 0, sum(d[:3])), id="A6 bends the hand forwards"),
        pytest.param((90, 90, 0, 0, 0, 0, 0), lambda d: (0, sum(d[1:]), d[0]), id="A1 turns to the left"),
        pytest.param((0, 0, 90, -90, 0, 0, 0), lambda d: (0, d[2] + d[3], d[0] + d[1]), id="A3 turns the forearm"),
        pytest.param((0, 0, 0, -90, 90, 90, 0), lambda d: (d[2], d[3], d[0] + d[1]), id="A5 turns the hand"),
    ],
)
def test_the_flange_lies_where_the_four_link_lengths_put_it(
    robot: Robot, name: str, degrees: tuple[float, ...], expected: Callable[[tuple[float, ...]], tuple[float, ...]]
) -> None:
    np.testing.assert_allclose(
        robot.tool_pose(_posture(*degrees), "left").translation, expected(SHEETS[name].lengths), atol=1e-9
    )


def test_a7_turns_the_flange_about_its_own_axis(robot: Robot) -> None:
    pose = robot.tool_pose(_posture(0, 0, 0, 0, 0, 0, 30), "left")
    np.testing.assert_allclose(pose.rotation, pin.utils.rotate("z", math.pi / 6), atol=1e-9)


def test_the_masses_of_links_equal_the_masses_in_the_source(name: str) -> None:
    urdf = load_description(name).urdf
    written = [float(mass.get("value", "nan")) for mass in urdf.findall("link/inertial/mass")]
    assert written == list(SHEETS[name].masses)
    model = pin.buildModelFromXML(compose(one_arm(model=name)).urdf)
    np.testing.assert_allclose([inertia.mass for inertia in model.inertias][1:], written[1:])


def test_the_inertias_of_links_are_physically_possible(robot: Robot) -> None:
    for inertia in list(robot.model.inertias)[1:]:
        principal = np.linalg.eigvalsh(inertia.inertia)
        assert principal[0] > 0
        assert principal[0] + principal[1] > principal[2]


def test_the_limits_of_joints_equal_the_limits_in_the_data_sheet_and_never_exceed_them(robot: Robot, name: str) -> None:
    position = np.radians([170, 120, 170, 120, 170, 120, 175])
    for actual, sheet in (
        (robot.position_upper, position),
        (-robot.position_lower, position),
        (robot.velocity_limit, np.radians(SHEETS[name].velocity)),
        (robot.torque_limit, np.array(SHEETS[name].torque, dtype=float)),
        (robot.acceleration_limit, np.array(SHEETS[name].acceleration)),
    ):
        np.testing.assert_allclose(actual, sheet, atol=2e-6)
        assert (actual <= sheet).all()


def test_the_model_has_the_rotor_inertias_and_gear_ratios_of_the_data_sheet(robot: Robot, name: str) -> None:
    sheet = SHEETS[name]
    np.testing.assert_allclose(robot.model.rotorInertia, sheet.rotor)
    np.testing.assert_allclose(robot.model.rotorGearRatio, sheet.gear)
    np.testing.assert_allclose(robot.model.armature, np.array(sheet.rotor) * np.square(sheet.gear))


@pytest.mark.parametrize(
    ("model", "link", "start", "end", "radius"),
    [
        ("iiwa7", 0, (0, 0, 0.059), (-0.033, 0, 0.067), 0.1198),
        ("iiwa7", 1, (0, 0, 0.0505), (0, -0.042, 0.1945), 0.0794),
        ("iiwa7", 2, (0, 0.0515, -0.001), (0, 0.0105, 0.144), 0.0799),
        ("iiwa7", 5, (0, 0, -0.0005), (0, -0.048, 0.1775), 0.0715),
        ("iiwa14", 0, (0, 0, 0.055), (-0.037, 0, 0.067), 0.1335),
        ("iiwa14", 1, (0, 0, 0.0395), (0, -0.031, 0.2135), 0.0910),
        ("iiwa14", 6, (0, 0.0697, -0.017), (0, 0.0707, 0.021), 0.0793),
    ],
)
def test_a_capsule_has_the_ends_for_its_mesh_and_its_radius_exceeds_the_needed_radius_by_at_most_1_5_mm(
    model: str, link: int, start: tuple[float, ...], end: tuple[float, ...], radius: float
) -> None:
    full = pin.buildModelFromXML(urdf := compose(one_arm(model=model)).urdf)
    geometry = pin.buildGeomFromUrdfString(full, urdf, pin.GeometryType.COLLISION)
    item = geometry.geometryObjects[geometry.getGeometryId(f"left_link_{link}_0")]
    half = np.array([0.0, 0.0, item.geometry.halfLength])
    in_link = full.frames[item.parentFrame].placement.inverse() * item.placement
    np.testing.assert_allclose(in_link.act(-half), start, atol=1e-6)
    np.testing.assert_allclose(in_link.act(half), end, atol=1e-6)
    assert radius < item.geometry.radius < radius + 0.0015
