"""Details of the controller's contract: rest, recovery, faults, the report, and solvers that attack the arms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.safety.safety_data import ROUNDING
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, StepStatus
from q2r2_control.verification.contract import Contract
from q2r2_control.verification.fault_injection import ATTACKS, FaultySolver, WorstSolver, untimed
from q2r2_control.wording import limit_name
from tests.control.scenarios import SCENARIOS, crossing
from tests.control.test_scenarios import controller_of, robot_of
from tests.support.driven import Driven


@pytest.fixture
def controller() -> CartesianController:
    controller, solver = controller_of("iiwa7")
    solver.fault = None
    return controller


def run(controller: CartesianController, scenario: Any, duration: float, dt: float, **start: Array) -> Contract:
    """Run a scenario for ``duration`` [s] from the state ``start`` (q, v), and check the contract at every tick."""
    driven = Driven(controller, dt=dt, **start)
    driven.drive(duration, scenario)
    return driven.contract


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "duration"),
    [
        pytest.param("crossing", 10.0, id="two arms that block each other"),
        pytest.param("same point", 6.0, id="both at one place"),
        pytest.param("unreachable", 6.0, id="out of reach"),
        pytest.param("overhead", 12.0, id="stretched out"),
        pytest.param("into the table", 4.0, id="pressing on the table"),
        pytest.param("one arm frozen", 10.0, id="against an arm that holds"),
    ],
)
def test_arms_with_constant_targets_come_to_rest_whether_the_targets_are_reachable_or_not(
    controller: CartesianController, name: str, duration: float
) -> None:
    assert run(controller, SCENARIOS[name], duration, 0.005).tail_acceleration() < 0.1


def test_a_tool_moves_to_a_reachable_target_and_stays_there(controller: CartesianController) -> None:
    driven = Driven(controller, dt=0.004)
    by = pin.SE3(pin.exp3(np.array([0.2, -0.3, 0.4])), np.array([0.05, 0.05, 0.15]))
    goal = {
        arm: pin.SE3(by.rotation @ pose.rotation, pose.translation + by.translation)
        for arm, pose in driven.start.items()
    }
    driven.drive(4.0, goal)
    assert driven.contract.tail_acceleration() < 0.1
    for side, pose in goal.items():
        error = controller.tool_pose(side).actInv(pose)
        assert np.linalg.norm(error.translation) < 1e-4
        assert np.linalg.norm(pin.log3(error.rotation)) < 1e-3


@pytest.mark.parametrize("dt", [0.0, -0.001, float("nan"), float("inf"), "soon"], ids=str)
def test_an_invalid_dt_moves_nothing_and_is_reported(controller: CartesianController, dt: Any) -> None:
    driven = Driven(controller, dt=0.001)
    for seconds in (0.0, 0.05):
        before = driven.drive(seconds, crossing) if seconds else controller.step({}, 0.0)
        reference = controller.step(crossing(0.0, driven.start), dt)
        np.testing.assert_array_equal(reference.q, before.q)
        np.testing.assert_array_equal(reference.a, 0.0)
        assert reference.report.status is StepStatus.DT_REJECTED
    assert np.abs(before.a).max() > 1.0


def test_a_dt_above_a_tenth_of_a_second_moves_the_arms_exactly_like_a_dt_of_a_tenth_of_a_second(
    controller: CartesianController,
) -> None:
    results = []
    for dt in (0.1, 5.0):
        driven = Driven(controller)
        results.append(controller.step(crossing(0.0, driven.start), dt))
    np.testing.assert_array_equal(results[0].q, results[1].q)
    assert [result.report.status for result in results] == [StepStatus.OK, StepStatus.DT_REJECTED]


@pytest.mark.parametrize("joint", [1, 6])
@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["lower", "upper"])
def test_a_joint_that_starts_outside_a_position_limit_returns_without_a_jump(
    controller: CartesianController, joint: int, side: float
) -> None:
    robot, q = controller.robot, controller.robot.home.copy()
    q[joint] = (robot.position_upper if side > 0 else robot.position_lower)[joint] + side * 0.05
    if min(pair.distance for pair in robot.distances(q)) < controller.settings.min_distance:
        pytest.skip(f"{robot.joint_names[joint]} there is in penetration too, which another test starts from")
    driven = Driven(controller, q)
    assert driven.drive(0.002).report.status is StepStatus.RECOVERING
    reference, margin = driven.drive(1.5), controller.settings.position_margin
    assert robot.position_lower[joint] + margin <= reference.q[joint] <= robot.position_upper[joint] - margin


def test_arms_leave_a_stretched_posture_nearly_as_fast_as_the_acceleration_limit_allows(
    controller: CartesianController,
) -> None:
    robot, q = controller.robot, controller.robot.home.copy()
    for arm in robot.arms.values():
        # Elbow and wrist are straight, so that the Jacobian has lost rank.
        q[arm.joints] = [0.0, 0.9, 0.0, 0.0, 0.0, 0.0, 0.0]
    driven = Driven(controller, q, dt=0.001)
    for pose, y in zip(driven.start.values(), (0.4, -0.4), strict=True):
        inwards = np.array([0.0, y, 0.34]) - pose.translation  # The vector from the tool to the shoulder.
        pose.translation = pose.translation + 0.15 * inwards / np.linalg.norm(inwards)
    error = 1.0
    while error > 0.01 and driven.ticks < 4000:
        reference = driven.drive(0.001, driven.start)
        error = max(
            float(np.linalg.norm(controller.tool_pose(arm).translation - pose.translation))
            for arm, pose in driven.start.items()
        )
    # At best, the joint with the longest path accelerates fully for half of the path, and then decelerates fully.
    limit = robot.capped_acceleration(controller.settings.acceleration_limit)
    fastest = 2.0 * np.sqrt((np.abs(reference.q - q) / limit).max())
    assert 0.001 * driven.ticks < 1.2 * fastest


def test_every_joint_uses_the_smaller_of_its_own_acceleration_limit_and_the_setting() -> None:
    limits = {"A2": 1.5, "A3": 12.0, "A4": 4.0}
    cell = load_config("config/dual_iiwa7.yaml")
    arms = {side: arm.model_copy(update={"acceleration_limit": limits}) for side, arm in cell.arms.items()}
    robot = Robot.from_config(cell.model_copy(update={"arms": arms}))
    driven = Driven(CartesianController(robot, ControllerSettings(acceleration_limit=9.0)), dt=0.001)
    for pose in driven.start.values():
        pose.translation = pose.translation + np.array([-0.1, 0.0, 0.15])
    v = np.array([driven.drive(0.001, driven.start).v for _ in range(600)])
    largest = np.abs(np.diff(v, axis=0, prepend=0.0)).max(axis=0)[:7] / 0.001
    assert (largest <= np.array([8.65, 1.5, 9.0, 4.0, 9.0, 9.0, 9.0]) * (1.0 + 1e-9)).all()
    np.testing.assert_allclose(largest[[1, 3]], [1.5, 4.0])
    assert largest[5] > 4.0


def test_a_solver_that_never_answers_brings_the_arms_to_rest_along_the_certified_stop() -> None:
    robot = robot_of("iiwa7")
    faulty = FaultySolver(DaqpSolver(14))
    driven = Driven(CartesianController(robot, solver=faulty))
    assert driven.drive(0.4, crossing).report.certified
    faulty.fault = "none"
    for _ in range(100):
        reference = driven.controller.step(crossing(0.0, driven.start), 0.002)
        driven.contract.check(reference, 0.002, failed=True)
        assert reference.report.certified
    assert not reference.v.any()


def test_the_report_names_the_limits_that_hold_the_arms_back(controller: CartesianController) -> None:
    report = Driven(controller, dt=0.005).drive(3.0, SCENARIOS["into the table"]).report
    assert any("envelope" in name and "table" in name for name in map(limit_name, report.binding))
    assert "table" in "|".join(report.closest_pair)
    assert report.certified
    assert not report.fallback


def least_margin(robot: Robot, settings: ControllerSettings, ticks: int, attack: str, seed: int) -> float:
    """Return the least margin of all pairs at all ticks [m], measured by Coal. Check that every tick is certified."""
    solver = FaultySolver(DaqpSolver(robot.model.nv), worst=WorstSolver(robot, np.random.default_rng(seed)))
    controller = CartesianController(robot, settings, solver=untimed(solver, robot.model.nv))
    solver.kept, solver.q = controller.kept_distances, robot.home
    controller.reset(robot.home)
    targets = crossing(0.0, {arm: controller.tool_pose(arm) for arm in robot.arms})
    contract = Contract(controller, robot.home, random=np.random.default_rng(seed))
    least = np.inf
    for tick in range(ticks):
        dt = (0.001, 0.004, 0.0005, 0.01, 0.03)[tick // 60 % 5]
        # The attack "again" needs an earlier answer to repeat.
        solver.fault = "towards_nearest" if attack == "again" and tick % 5 == 0 else attack
        reference = controller.step(targets, dt)
        contract.check(reference, dt)
        solver.q = reference.q
        least = min(least, float((robot.distance_values(reference.q) - controller.kept_distances).min()))
        assert reference.report.certified
    return least


@pytest.mark.parametrize("attack", ATTACKS)
def test_no_attacking_solver_brings_a_pair_closer_than_its_kept_distance(attack: str) -> None:
    least = least_margin(robot_of("iiwa7"), load_config("config/dual_iiwa7.yaml").control, 600, attack, seed=1)
    assert -ROUNDING <= least < 1e-4, "it has to get there, and no further"


def test_if_a_pair_is_too_close_by_a_rounding_error_all_steps_are_certified_and_the_pair_opens_to_its_buffer() -> None:
    robot = robot_of("iiwa7")
    nearest = float(robot.distance_values(robot.home).min())
    settings = ControllerSettings(min_distance=nearest + 1e-15)
    assert nearest < settings.min_distance
    controller = CartesianController(robot, settings)
    reports = [controller.step({}, 0.001).report for _ in range(100)]
    assert all(report.certified for report in reports)
    assert StepStatus.RECOVERING not in {report.status for report in reports}
    assert reports[-1].margin > 1e-4, "the pair opens to its buffer"
    assert -ROUNDING <= least_margin(robot, settings, 300, "towards_nearest", seed=2) < 0.0


def test_a_controller_that_starts_with_an_unproven_stop_has_no_certificate_until_it_certifies_a_step() -> None:
    controller, solver = controller_of("iiwa7")
    q, turn = controller.robot.home.copy(), np.zeros(controller.robot.model.nv)
    turn[[arm.joints[0] for arm in controller.robot.arms.values()]] = [-1.0, 1.0]  # The arms turn towards each other.
    for speed in np.arange(0.5, 1.0, 5e-4):
        controller.reset(q + 0.3 * turn, speed * turn)
        if not controller.step({}, 0.0).report.certified:
            break  # At this speed, the arms start a little too fast for a certified stop.
    solver.fault = "none"
    reports = [controller.step({}, 0.001).report for _ in range(5)]
    assert not any(report.certified for report in reports)
    assert min(report.margin for report in reports) > 0.015
    solver.fault = None
    reports = [controller.step({}, 0.001).report for _ in range(300)]
    assert all(report.certified and report.margin >= 0.0 for report in reports)


@pytest.mark.parametrize("brakes", [False, True], ids=["steps", "a stop before each step"])
def test_the_step_in_which_a_pair_stops_being_too_close_is_the_last_without_a_certificate(brakes: bool) -> None:
    robot = robot_of("iiwa7")
    settings = ControllerSettings(min_distance=float(robot.distance_values(robot.home).min()) + 1e-5)
    controller = CartesianController(robot, settings)
    reports = []
    for _ in range(100):
        if brakes:
            controller.brake(1e-6)
        reports.append(controller.step({}, 0.001).report)
    apart = next(tick for tick, report in enumerate(reports) if report.margin >= 0.0)
    assert apart > 0
    assert [tick for tick, report in enumerate(reports) if not report.certified] == list(range(apart + 1))
