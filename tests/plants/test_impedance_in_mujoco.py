"""The impedance controller in a loop with MuJoCo: stiffness, damping, contact, wrong masses, and all bounds."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import cumulative_trapezoid

from q2r2_control.config.cell import Config
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.plants.conftest import tool_motion
from tests.support.torque_loop import DT, TorqueLoop, left_arm, reference

POSTURES = {
    "home": None,
    "reaching far": [0.2, 0.9, -0.3, -0.75, 0.1, 1.3, 0.3],
    "drawn in": [0.3, -0.2, -0.5, -1.8, 0.3, 1.2, 0.5],
    "high": [0.4, 0.3, -0.3, -1.0, 0.5, -0.6, 0.2],
    "elbow out": [0.6, 0.5, -1.2, -1.5, 0.9, 1.2, -0.3],
}
# Masses of links 0..7 of an iiwa 7 in Drake's description [kg]. The URDF has the masses of another public description.
OTHER_MASSES = (3.863, 2.7025, 2.7258, 3.175, 2.73, 1.69, 1.8, 0.4)
SETTINGS = ImpedanceSettings()
FORCE = 20.0  # [N]
SLOW = 0.002  # A longer tick for slow motions, in which milliseconds do not matter [s].


@pytest.fixture(scope="module")
def bare_config(config: Config) -> Config:
    """Return the cell without blocks, so that the tool can move down to the table."""
    return config.model_copy(update={"mujoco": config.mujoco.model_copy(update={"objects": {}})})


@pytest.fixture(scope="module")
def bare(robot: Robot, bare_config: Config) -> MujocoPlant:
    return MujocoPlant(robot, bare_config)


@pytest.fixture(scope="module")
def reweighed(robot: Robot, bare_config: Config) -> MujocoPlant:
    """Return arms whose links have other masses than the controller expects."""
    plant = MujocoPlant(robot, bare_config)
    for arm in robot.arms:
        for link, mass in enumerate(OTHER_MASSES):
            body = plant.model.body(f"{arm}_link_{link}")
            body.inertia *= mass / body.mass[0]
            body.mass[0] = mass
    mujoco.mj_setConst(plant.model, plant.data)
    return plant


def posture(robot: Robot, name: str) -> Array:
    q = robot.home.copy()
    left = POSTURES[name]
    if left is not None:
        q[robot.arms["left"].joints] = left
    return q


def along(axis: int, force: float = FORCE) -> Array:
    return force * np.eye(6)[axis]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "axis"), [("home", 0), ("reaching far", 1), ("drawn in", 2), ("high", 0), ("elbow out", 1)]
)
def test_a_push_moves_the_tool_by_the_force_divided_by_the_stiffness(
    bare: MujocoPlant, robot: Robot, name: str, axis: int
) -> None:
    loop = TorqueLoop(bare, robot, SETTINGS, posture(robot, name), SLOW)
    bare.push("left", along(axis), 60.0)
    loop.settle()
    expected = FORCE / SETTINGS.translational_stiffness
    displacement = loop.displacement()
    np.testing.assert_allclose(displacement[:3], expected * np.eye(3)[axis], atol=0.05 * expected)
    assert np.linalg.norm(displacement[3:]) < np.radians(0.05)
    assert np.linalg.norm(loop.displacement("right")) < 1e-4


def modes(robot: Robot, settings: ImpedanceSettings) -> tuple[Array, Array]:
    """Return the frequencies (6,) [rad/s] and shapes V (6, 6) of the modes of the left tool on its spring.

    V' Lambda V = 1 holds, where Lambda is the tool's inertia.
    """
    J, M = left_arm(robot, robot.home)
    inertia = np.linalg.inv(J @ np.linalg.solve(M, J.T))
    stiffness = np.diag([settings.translational_stiffness] * 3 + [settings.rotational_stiffness] * 3)
    squares, V = scipy.linalg.eigh(stiffness, inertia)
    return np.sqrt(squares), V


def fitted_ratio(z: Array) -> float:
    """Return the damping ratio xi of z'' + 2 xi w z' + w^2 z = 0 that best fits ``z`` after a release from rest.

    Integrated twice, the equation is z - z_0 = -2 xi w S(z - z_0) - w^2 SS z, where S is the integral over time. It is
    linear in 2 xi w and w^2, and contains no derivative of a measurement. The fit works for every xi. A logarithmic
    decrement, in contrast, needs an oscillation.
    """
    first = cumulative_trapezoid(z - z[0], dx=DT, initial=0)
    second = cumulative_trapezoid(cumulative_trapezoid(z, dx=DT, initial=0), dx=DT, initial=0)
    (damping, square), *_ = np.linalg.lstsq(np.column_stack([-first, -second]), z - z[0], rcond=None)
    return float(damping / (2 * np.sqrt(square)))


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.7, 1.0])
def test_each_mode_of_the_tool_on_its_spring_returns_with_the_damping_ratio_of_the_settings(
    bare: MujocoPlant, robot: Robot, ratio: float
) -> None:
    settings = SETTINGS.model_copy(update={"damping_ratio": ratio})
    frequencies, V = modes(robot, settings)
    stiffness = np.repeat([settings.translational_stiffness, settings.rotational_stiffness], 3)
    for frequency, shape in zip(frequencies, V.T, strict=True):
        # Each mode is tested alone, because the remaining motion of a slow mode would hide a fast mode.
        wrench = stiffness * shape
        wrench *= min(15.0 / np.linalg.norm(wrench[:3]), 4.0 / np.linalg.norm(wrench[3:]))
        loop = TorqueLoop(bare, robot, settings, robot.home)
        bare.push("left", wrench, 8.0 / frequency)
        loop.run(8.0 / frequency)
        way = [loop.displacement()]
        way += [loop.displacement() for _ in loop.ticks(6.0 / frequency)]
        z = np.array(way) @ np.linalg.inv(V).T @ (V.T @ wrench / np.linalg.norm(V.T @ wrench))
        assert fitted_ratio(z) == pytest.approx(ratio, abs=0.1), f"mode of {frequency:.1f} rad/s"
        overshoot = max(0.0, float(-(z / z[0]).min()))
        if ratio == 1.0:
            assert overshoot < 1e-3
        else:
            logarithm = np.log(overshoot)
            assert -logarithm / np.hypot(np.pi, logarithm) == pytest.approx(ratio, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["home", "reaching far", "elbow out"])
def test_arms_whose_masses_differ_from_the_controllers_model_stay_stable_and_within_2_cm(
    reweighed: MujocoPlant, robot: Robot, name: str
) -> None:
    loop = TorqueLoop(reweighed, robot, SETTINGS, posture(robot, name), SLOW)
    largest = 0.0
    for _ in loop.ticks(2.5):
        largest = max(largest, *(float(np.linalg.norm(loop.displacement(arm)[:3])) for arm in robot.arms))
    static = 1e3 * np.linalg.norm(loop.displacement()[:3])
    message = f"largest tool error {1e3 * largest:.1f} mm, static {static:.1f} mm from gravity that is not compensated"
    assert largest < 0.02, message
    assert static > 1.0, "the masses are others"
    assert np.abs(loop.state.v).max() < 2e-3, message


@pytest.mark.slow
def test_a_tool_hits_the_table_at_0_1_m_s_and_bounces_at_most_twice(bare: MujocoPlant, robot: Robot) -> None:
    loop = TorqueLoop(bare, robot, SETTINGS.model_copy(update={"damping_ratio": 0.7}), robot.home)
    way = list(tool_motion(robot, "left", np.array([0.0, 0.0, -0.1]), 2.5, DT, robot.home))
    touching = []
    v = np.zeros(14)
    for command in way:
        loop.reference = reference(command.q, command.v, (command.v - v) / DT)
        v = command.v
        loop.tick()
        touching.append(touches_table(bare))
    loop.reference = reference(way[-1].q)
    for _ in loop.ticks(1.0):
        touching.append(touches_table(bare))
    lost = int(np.sum(np.diff(np.array(touching, dtype=int)) == -1))
    assert lost <= 2
    assert not touching[0]
    assert all(touching[-1000:])
    assert np.abs(loop.state.v).max() < 2e-3
    # The table bears the force that compresses the spring.
    depth = robot.tool_pose(loop.state.q, "left").translation - robot.tool_pose(way[-1].q, "left").translation
    assert 0.03 < depth[2] < 0.1
    external = loop.state.tau_external
    assert external is not None
    J, _ = left_arm(robot, loop.state.q)
    force, *_ = np.linalg.lstsq(J.T, external[:7], rcond=None)
    assert force[2] == pytest.approx(SETTINGS.translational_stiffness * depth[2], rel=0.05)


def touches_table(plant: MujocoPlant) -> bool:
    table = plant.model.geom("table_collision").id
    return any(table in (contact.geom1, contact.geom2) for contact in plant.data.contact)


@pytest.mark.parametrize("wrench", [along(0), along(2, -FORCE)], ids=["sideways", "down"])
def test_a_stretched_arm_stays_stable(bare: MujocoPlant, robot: Robot, wrench: Array) -> None:
    loop = TorqueLoop(bare, robot, SETTINGS, np.zeros(14), SLOW)
    bare.push("left", wrench, 0.5)
    for _ in loop.ticks(0.5):
        assert np.linalg.norm(loop.displacement()[:3]) < 0.012
    loop.settle()
    assert np.linalg.norm(loop.displacement()[:3]) < 1e-3


def test_after_a_blow_an_arm_keeps_the_bounds_of_its_torques_and_comes_back(bare: MujocoPlant, robot: Robot) -> None:
    settings = SETTINGS.model_copy(update={"torque_rate_limit": 1000.0})
    loop = TorqueLoop(bare, robot, settings, robot.home, SLOW)
    bare.push("left", np.array([0.0, 300.0, 300.0, 0, 0, 0]), 0.15)
    limited, clipped = set(), set()
    for command in loop.ticks(0.5):
        limited |= set(command.report.rate_limited)
        clipped |= set(command.report.clipped)
    assert limited
    assert clipped == {"left"}
    loop.settle()
    assert np.linalg.norm(loop.displacement()[:3]) < 2e-3


def test_a_held_mass_that_the_controller_knows_causes_no_sag_and_no_jump_of_torques(bare_config: Config) -> None:
    """A mass of 2 kg at the tool frame causes a sag of 9.8 mm at 2000 N/m if the controller does not know the mass."""
    data = bare_config.model_dump()
    data["arms"]["left"]["gripper"]["object"] = {"mass": 2.0}
    config = Config.model_validate(data)
    robot = Robot.from_config(config)
    plant = MujocoPlant(robot, config)
    tool = plant.model.body(robot.arms["left"].tool_frame)
    tool.mass[0], tool.inertia[:] = 2.0, 0.4 * 2.0 * 0.03**2
    mujoco.mj_setConst(plant.model, plant.data)
    loop = TorqueLoop(plant, robot, SETTINGS, robot.home, SLOW)
    loop.run(1.5)
    assert loop.displacement()[2] == pytest.approx(-2.0 * 9.81 / SETTINGS.translational_stiffness, rel=0.1)
    before = loop.controller.gravity(robot.home)
    loop.controller.set_holding({"left": True, "right": False})
    torques = np.array([command.tau for command in loop.ticks(1.5)])
    assert np.abs(loop.displacement()[:3]).max() < 1e-4
    assert np.abs(loop.controller.gravity(robot.home) - before).max() > 5.0
    assert np.abs(np.diff(torques, axis=0)).max() < 0.5
    loop.controller.set_holding({"left": False})
    loop.run(0.5)
    np.testing.assert_allclose(loop.controller.gravity(robot.home), before, atol=1e-9)
