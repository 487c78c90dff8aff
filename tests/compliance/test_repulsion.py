"""The wall, which pushes measured links apart: its energy, its stability, and pushed arms in MuJoCo."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache

import coal
import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.compliance.repulsion import MeasuredSeparation, WallReport
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ControllerSettings, WallSettings
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import ConfigError
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.finger_bodies import collision_model_at
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode
from tests.control.cells import cell, random_posture
from tests.control.test_moving_obstacles import Coal
from tests.support.coal_distances import coal_distances
from tests.support.object_cell import BLOCK
from tests.support.object_cell import cell as object_cell

ROBOT = cell("dual_iiwa7").robot
SHELL = ControllerSettings().min_distance
REST = np.zeros(len(ROBOT.home))


@cache
def wall(**settings: float) -> MeasuredSeparation:
    return MeasuredSeparation(ROBOT, ControllerSettings(), WallSettings(**settings))


@cache
def _postures() -> list[tuple[Array, WallReport]]:
    """Return postures in which the wall pushes some pair apart and no pair touches, each with the wall's report."""
    random, found = np.random.default_rng(31), []
    for _ in range(12000):
        q = random_posture(ROBOT, random)
        report = wall().update(q, REST)
        if report.pressing and report.closest_distance > 0.0:
            found.append((q, report))
    return found


def _of_two_arms(pair: tuple[str, str]) -> bool:
    return {name.split("_")[0] for name in pair} == {"left", "right"}


def _with_the_table(pair: tuple[str, str]) -> bool:
    return any(name.startswith("table") for name in pair)


def _mass_matrix(q: Array) -> Array:
    upper = np.triu(pin.crba(ROBOT.model, ROBOT.model.createData(), q))
    return np.asarray(upper + np.triu(upper, 1).T)


@pytest.mark.parametrize("kind", [_of_two_arms, _with_the_table], ids=["two arms", "an arm and the table"])
def test_the_torque_at_rest_is_the_negative_gradient_of_the_energy_of_the_wall(
    kind: Callable[[tuple[str, str]], bool],
) -> None:
    chosen = [(q, report) for q, report in _postures() if any(map(kind, report.pressing))][:40]
    assert len(chosen) >= 20
    assert max(len(report.pressing) for _, report in chosen) >= 3
    for q, report in chosen:
        slope = np.zeros(len(q))
        for j in range(len(q)):
            step = 1e-6 * np.eye(len(q))[j]
            slope[j] = (wall().update(q + step, REST).energy - wall().update(q - step, REST).energy) / 2e-6
        np.testing.assert_allclose(report.tau, -slope, rtol=1e-4, atol=1e-3)
        assert np.abs(report.tau).max() > 0.0


def test_the_energy_equals_the_energy_of_springs_compressed_by_the_depths_that_coal_measures() -> None:
    stiffness = WallSettings().stiffness
    for q, report in _postures()[:100]:
        depth = np.array([max(SHELL - pair.distance, 0.0) for pair in ROBOT.distances(q)])
        spring = 0.5 * stiffness * float((depth**2).sum())
        # Smooth distances are up to 0.3 mm longer than exact distances.
        least = 0.5 * stiffness * float((np.maximum(depth - 3e-4, 0.0) ** 2).sum())
        assert least - 1e-9 <= report.energy <= spring + 1e-4


def test_the_report_names_the_pairs_that_the_wall_pushes_apart_and_the_closest_pair() -> None:
    for q, report in _postures()[:50]:
        distances = {frozenset((pair.name_a, pair.name_b)): pair.distance for pair in ROBOT.distances(q)}
        assert distances[frozenset(report.closest_pair)] == pytest.approx(report.closest_distance, abs=1e-4)
        assert report.closest_distance == pytest.approx(min(distances.values()), abs=1e-4)
        pressing = {frozenset(pair) for pair in report.pressing}
        assert all(distances[pair] < SHELL for pair in pressing)
        assert all(pair in pressing for pair, distance in distances.items() if distance < SHELL - 4e-4)


def test_in_the_report_a_pair_that_may_touch_does_not_hide_a_pair_that_must_not_touch() -> None:
    q = ROBOT.home.copy()
    q[1] = 0.7  # The left fingers are 10 mm inside the table.
    contact = {"pair": ("*_finger_*", "table"), "depth": 0.015, "speed": 0.03}
    settings = ControllerSettings.model_validate({"contact_allowed": [contact]})
    assert wall().update(q, REST).closest_distance == pytest.approx(-0.01, abs=1e-3)
    assert MeasuredSeparation(ROBOT, settings).update(q, REST).closest_distance == 0.0
    q[9] = q[2] = 0.0
    q[1] = q[8] = 0.85  # The hands are inside the table too.
    report = MeasuredSeparation(ROBOT, settings).update(q, REST)
    assert report.closest_distance < 0.0
    assert not any("finger" in name for name in report.closest_pair)


def test_after_openings_are_set_the_wall_uses_the_finger_bodies_for_these_openings() -> None:
    random, separation = np.random.default_rng(4), MeasuredSeparation(ROBOT, ControllerSettings(), WallSettings())
    closed = collision_model_at(ROBOT.collision_model, ROBOT.finger_bodies, {"left": (0.0, 0.1)})
    farther = 0
    for q, report in [_postures()[i] for i in random.choice(len(_postures()), 60, replace=False)]:
        separation.set_openings({"left": (0.0, 0.1)})
        by_coal = float(coal_distances(ROBOT, closed, q).min())
        assert separation.update(q, REST).closest_distance == pytest.approx(by_coal, abs=2e-6)
        farther += by_coal > report.closest_distance + 1e-4
        separation.set_openings({})
        np.testing.assert_array_equal(separation.update(q, REST).tau, report.tau)
    assert farther > 2


def test_there_is_no_torque_at_any_speed_if_all_pairs_keep_their_distance() -> None:
    random, seen = np.random.default_rng(32), 0
    for _ in range(400):
        q, v = random_posture(ROBOT, random), random.normal(0.0, 2.0, len(REST))
        if min(pair.distance for pair in ROBOT.distances(q)) > SHELL:
            report = wall().update(q, v)
            assert not report.tau.any()
            assert report.pressing == ()
            assert report.force == report.energy == 0.0
            seen += 1
    assert seen > 20


def test_the_wall_never_pulls_a_pair_together_at_any_speed() -> None:
    single = [(q, report) for q, report in _postures() if len(report.pressing) == 1 and report.force > 5.0][:30]
    assert len(single) >= 10
    for q, report in single:
        away = report.tau / np.linalg.norm(report.tau)
        weaker = 0
        for speed in (-5.0, -0.5, -0.05, 0.05, 0.5, 5.0):
            torque = wall().update(q, speed * away).tau
            along = float(torque @ away)
            np.testing.assert_allclose(torque, along * away, atol=1e-9)
            assert along >= 0.0
            assert (along >= np.linalg.norm(report.tau) - 1e-9) == (speed < 0.0), "more when closing, less when opening"
            weaker += along == 0.0
        assert weaker >= 1, "fast enough out, it lets go"


def test_the_damping_never_adds_energy() -> None:
    random = np.random.default_rng(33)
    for q, report in _postures()[:200]:
        v = random.normal(0.0, 0.3, len(REST))
        assert (wall().update(q, v).tau - report.tau) @ v <= 1e-9


@pytest.mark.slow
def test_the_torque_of_the_wall_rises_gradually_while_a_pair_approaches() -> None:
    crossed = 0
    for q, report in _postures()[:12]:
        # The approach begins outside the wall, and moves against the torque at constant speed in very small steps.
        direction = report.tau / np.linalg.norm(report.tau)
        way = np.linspace(0.1, 0.0, 8001)
        torques = np.array([wall().update(q + s * direction, -0.3 * direction).tau for s in way])
        assert np.linalg.norm(np.diff(torques, axis=0), axis=1).max() < 1.5
        crossed += bool(not torques[0].any() and np.linalg.norm(torques[-1]) > 10.0)
    assert crossed >= 3


def test_the_repulsion_of_many_pairs_is_scaled_down_at_high_stiffness_but_not_at_the_default_stiffness() -> None:
    firm = {"maximum_force": 2000.0}
    stiffest = max(_postures(), key=lambda posture: len(posture[1].pressing))[0]
    for q, _ in _postures():
        soft, default = (wall(stiffness=k, **firm).update(q, REST).tau for k in (5e3, 1e4))
        np.testing.assert_allclose(default, 2.0 * soft, rtol=1e-9, atol=1e-9)
    soft, hard = (wall(stiffness=k, **firm).update(stiffest, REST).tau for k in (5e3, 1e5))
    assert np.linalg.norm(hard) < 19.0 * np.linalg.norm(soft)


@pytest.mark.parametrize("stiffness", [1e4, 1e5])
def test_the_damping_of_all_pairs_together_stays_below_a_quarter_of_the_stable_maximum(
    stiffness: float,
) -> None:
    separation, bound = wall(stiffness=stiffness, damping_ratio=2.0, maximum_force=2000.0), 0.5 / 0.002
    stacked = sorted(_postures(), key=lambda posture: -len(posture[1].pressing))[:40]
    reached = 0.0
    for q, _ in stacked:
        still = separation.update(q, REST).tau
        columns = [(still - separation.update(q, 1e-7 * unit).tau) / 1e-7 for unit in np.eye(len(q))]
        fastest = float(np.linalg.eigvals(np.linalg.solve(_mass_matrix(q), np.array(columns).T)).real.max())
        assert fastest <= bound * (1 + 1e-4)
        reached = max(reached, fastest)
    assert reached > 0.5 * bound


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_give_neither_torque_nor_distance(bad: float) -> None:
    q = _postures()[0][0]
    broken = q.copy()
    broken[3] = bad
    for report in (wall().update(broken, REST), wall().update(q, broken)):
        assert not report.tau.any()
        assert np.isnan(report.closest_distance)
    assert wall().update(q, REST).pressing, "and the next tick is as ever"


@pytest.mark.parametrize("key", ["stiffness", "damping_ratio", "maximum_force"])
def test_wall_settings_that_would_not_push_bodies_apart_or_would_add_energy_are_refused(key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        WallSettings(**{key: 0.0})


ROD = """<robot name="rod"><link name="base"/><link name="rod"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="hinge" type="revolute">
<parent link="base"/><child link="rod"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint></robot>"""


def test_for_a_robot_without_pairs_the_wall_has_no_torque() -> None:
    robot = Robot.from_urdf(ROD, {"left": "rod"}, unchecked_links=["rod"])
    report = MeasuredSeparation(robot, ControllerSettings()).update(np.zeros(1), np.ones(1))
    assert not report.tau.any()
    assert report.closest_distance == np.inf


HOLD, HOLD_DAMPING = 2000.0, 60.0  # Stiffness [Nm/rad] and damping [Nm s/rad] that hold the right arm's joints.


def _pushed(
    force: float, friction: float, dt: float, separation: MeasuredSeparation
) -> Iterator[tuple[WallReport, float, float, float]]:
    """Push the left hand for 1.5 s towards the right hand, 60 mm away, and then release it for 1.5 s.

    Yields at each tick:
        The report on the wall, the energy [J], the work of the push [J], and the distance of the closest pair [m],
        which Coal measures. The energy is the sum of the energies of the motion, of the wall, and of the springs that
        hold the right arm.
    """
    q = ROBOT.home.copy()
    while min(pair.distance for pair in ROBOT.distances(q) if _of_two_arms((pair.name_a, pair.name_b))) > 0.06:
        q += 0.005 * np.array([-1, *[0] * 6, 1, *[0] * 6])
    plant, data, held = MujocoPlant(ROBOT, load_config("config/dual_iiwa7.yaml")), ROBOT.model.createData(), q[7:]
    plant.reset(q)
    plant.push("left", np.array([0.0, -force, 0.0, 0.0, 0.0, 0.0]), 1.5)
    work, before = 0.0, ROBOT.tool_pose(q, "left").translation[1]
    for tick in range(round(3.0 / dt)):
        state = plant.state()
        here = ROBOT.tool_pose(state.q, "left").translation[1]
        work += -force * (here - before) * (tick * dt <= 1.5)
        before = here
        report = separation.update(state.q, state.v)
        tau = pin.computeGeneralizedGravity(ROBOT.model, data, state.q) + report.tau - friction * state.v
        tau[7:] += HOLD * (held - state.q[7:]) - HOLD_DAMPING * state.v[7:]
        kinetic = 0.5 * float(state.v @ _mass_matrix(state.q) @ state.v)
        spring = 0.5 * HOLD * float(((held - state.q[7:]) ** 2).sum())
        coal = min(pair.distance for pair in ROBOT.distances(state.q)) if tick % 5 == 0 else report.closest_distance
        yield report, kinetic + spring + report.energy, work, coal
        plant.apply(Command(CommandMode.TORQUE, state.q, state.v, tau, {}))
        plant.advance(dt)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "dt", "stiffness", "least"),
    [
        pytest.param(1.0, 0.001, 1e4, 0.002, id="hardly braked"),
        pytest.param(10.0, 0.002, 1e5, 0.01, id="braked, slow loop, ten times the stiffness"),
    ],
)
def test_an_arm_that_is_pushed_with_40_newtons_towards_the_other_arm_never_touches_it_and_gains_no_energy(
    friction: float, dt: float, stiffness: float, least: float
) -> None:
    pressed, released = 0, []
    pushed = _pushed(40.0, friction, dt, wall(stiffness=stiffness))
    for tick, (report, energy, work, distance) in enumerate(pushed):
        assert distance > least
        assert energy <= work + 0.01, "the push's work is all there is"
        pressed += bool(report.pressing)
        if tick * dt > 1.5:
            released.append(energy)
            assert released[-1] <= released[0] + 1e-3
            assert len(released) < 2 or released[-1] <= released[-2] + 2e-4
    assert pressed * dt > 0.1
    assert released[-1] < 0.7 * released[0]


def test_a_wall_that_gets_new_kept_distances_pushes_like_a_wall_that_was_made_with_these_distances() -> None:
    wider = ControllerSettings(min_distance=0.04)
    made, told = MeasuredSeparation(ROBOT, wider), MeasuredSeparation(ROBOT, ControllerSettings())
    q = _postures()[0][0]
    assert not np.array_equal(told.update(q, REST).tau, made.update(q, REST).tau)
    told.set_kept_distances(kept_distances(ROBOT, wider).values)
    np.testing.assert_array_equal(told.update(q, REST).tau, made.update(q, REST).tau)


def test_an_arm_that_is_pushed_towards_a_new_box_does_not_touch_the_box_until_the_box_is_removed() -> None:
    controller = CartesianController(ROBOT, ControllerSettings(moving_obstacles=("hand", "box")))
    separation, size = MeasuredSeparation(ROBOT, controller.settings), (0.2, 0.05, 0.3)
    at = ROBOT.tool_pose(ROBOT.home, "left").translation + np.array([0.0, 0.14, 0.0])
    box = MovingObstacle(shape="box", size=size, position=tuple(at.tolist()), speed=0.0)
    measured, data = Coal(controller, coal.Box(*size)), ROBOT.model.createData()
    assert 0.03 < measured.distances(ROBOT.home, at).min() < 0.1
    least = {}
    for known in (True, False):
        controller.move_obstacle("box", box if known else None)
        separation.set_obstacles(controller.still_obstacles)
        plant, distances, pressing = MujocoPlant(ROBOT, load_config("config/dual_iiwa7.yaml")), [], set()
        plant.push("left", np.array([0.0, 40.0, 0.0, 0.0, 0.0, 0.0]), 1.5)
        for _ in range(1500):
            state = plant.state()
            report = separation.update(state.q, state.v)
            pressing |= {name for pair in report.pressing for name in pair}
            distances.append(float(measured.distances(state.q, at).min()))
            assert report.closest_distance <= distances[-1] + 1e-6 or not known
            tau = pin.computeGeneralizedGravity(ROBOT.model, data, state.q) + report.tau - 5.0 * state.v
            plant.apply(Command(CommandMode.TORQUE, state.q, state.v, tau, {}))
            plant.advance(0.001)
        least[known] = min(distances)
        assert ("box_0" in pressing) == known
    assert least[True] > 0.002
    assert least[False] < 0.0


@pytest.mark.parametrize("with_object", [False, True], ids=["empty hands", "an object in one hand's reach"])
def test_the_wall_pushes_an_arm_away_from_an_obstacle_only_if_its_reported_speed_is_0(with_object: bool) -> None:
    robot = Robot.from_config(object_cell(BLOCK)) if with_object else ROBOT
    controller = CartesianController(robot, ControllerSettings(moving_obstacles=("hand", "box")))
    separation = MeasuredSeparation(robot, controller.settings)
    at = robot.tool_pose(robot.home, "left").translation
    for speed in (0.0, 0.25):
        hand = MovingObstacle(shape="sphere", size=(0.1,), position=tuple(at.tolist()), speed=speed)
        controller.move_obstacle("hand", hand)
        separation.set_obstacles(controller.still_obstacles)
        assert separation.update(robot.home, np.zeros(robot.model.nv)).tau.any() == (speed == 0.0)
