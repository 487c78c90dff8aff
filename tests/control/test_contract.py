"""The controller's contract in particular: rest, recovery, faults, hostile input, what the report says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.qp import make_solver
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, StepStatus
from q2r2_control.verification.contract import Contract
from q2r2_control.verification.fault_injection import FaultySolver
from q2r2_control.wording import limit_name
from tests.control.scenarios import SCENARIOS, circle, crossing
from tests.control.test_scenarios import controller_of, in_penetration, robot_of
from tests.support.driven import Driven


def iiwa7s() -> CartesianController:
    controller, solver = controller_of("iiwa7")
    solver.fault = None
    return controller


def run(controller: CartesianController, scenario: Any, duration: float, dt: float, **start: Array) -> Contract:
    """Run a scenario from a ``start`` q and v and assert the contract at every tick."""
    driven = Driven(controller, dt=dt, **start)
    driven.drive(duration, scenario)
    return driven.contract


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
def test_a_constant_target_ends_in_rest_reachable_or_not(name: str, duration: float) -> None:
    contract = run(iiwa7s(), SCENARIOS[name], duration, 0.005)
    assert contract.tail_acceleration() < 0.1


def test_a_reachable_target_is_reached_and_held() -> None:
    controller = iiwa7s()
    goal: dict[str, pin.SE3 | None] = {}

    def turned(t: float, start: Any) -> dict[str, pin.SE3 | None]:
        for side, pose in start.items():
            turn = pin.exp3(np.array([0.2, -0.3, 0.4]))
            goal[side] = pin.SE3(turn @ pose.rotation, pose.translation + np.array([0.05, 0.05, 0.15]))
        return goal

    contract = run(controller, turned, 4.0, 0.002)
    assert contract.tail_acceleration() < 0.1
    for side, pose in goal.items():
        error = controller.tool_pose(side).actInv(pose)
        assert np.linalg.norm(error.translation) < 1e-4
        assert np.linalg.norm(pin.log3(error.rotation)) < 1e-3


def test_ten_thousand_hostile_ticks_neither_raise_nor_break_a_limit() -> None:
    controller = iiwa7s()
    controller.reset(controller.robot.home)
    contract = Contract(controller, controller.robot.home)
    random = np.random.default_rng(11)
    for _ in range(10_000):
        dt = float(10.0 ** random.uniform(-9.0, -2.0))
        contract.check(controller.step({side: _hostile(random) for side in ("left", "right", "nobody")}, dt), dt)
    assert contract.uncertified == 0


def _hostile(random: np.random.Generator) -> Any:
    kind = random.integers(10)
    pose = pin.SE3(pin.exp3(random.normal(size=3) * 2.0), random.uniform([-0.5, -1.0, -0.2], [1.2, 1.0, 1.4]))
    if kind == 0:
        pose.translation = np.array([np.nan, 0.0, 0.0])
    elif kind == 1:
        pose.translation = random.normal(size=3) * 10.0 ** random.uniform(0.0, 300.0)
    elif kind == 2:
        pose.rotation = pose.rotation * random.choice([0.0, 0.5, -1.0, np.inf])
    elif kind == 3:
        return random.choice(np.array([None, "here", 3.0, float("nan")], dtype=object))
    return pose


@pytest.mark.parametrize("dt", [0.0, -0.001, float("nan"), float("inf"), "soon", None], ids=str)
def test_a_dt_that_is_no_time_moves_nothing_and_says_so(dt: Any) -> None:
    controller = iiwa7s()
    controller.reset(controller.robot.home)
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    reference = controller.step(crossing(0.0, start), dt)
    np.testing.assert_array_equal(reference.q, controller.robot.home)
    assert reference.report.status is StepStatus.DT_REJECTED
    for tick in range(50):
        moving = controller.step(crossing(tick * 0.001, start), 0.001)
    assert np.abs(moving.a).max() > 1.0
    reference = controller.step(crossing(0.05, start), dt)
    np.testing.assert_array_equal(reference.q, moving.q)
    np.testing.assert_array_equal(reference.a, 0.0)


def test_a_dt_above_a_tenth_of_a_second_moves_no_further_than_that() -> None:
    controller = iiwa7s()
    results = []
    for dt in (0.1, 5.0):
        controller.reset(controller.robot.home)
        start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
        results.append(controller.step(crossing(0.0, start), dt))
    np.testing.assert_array_equal(results[0].q, results[1].q)
    assert [result.report.status for result in results] == [StepStatus.OK, StepStatus.DT_REJECTED]


@pytest.mark.parametrize("joint", range(7))  # of the left arm, whose mirror image the right one is
@pytest.mark.parametrize("side", [-1.0, 1.0], ids=["lower", "upper"])
def test_started_outside_a_position_limit_it_returns_without_a_jump(joint: int, side: float) -> None:
    controller = iiwa7s()
    robot = controller.robot
    q = robot.home.copy()
    limit = robot.position_upper[joint] if side > 0 else robot.position_lower[joint]
    q[joint] = limit + side * 0.05
    start_distance = min(pair.distance for pair in robot.distances(q))
    if start_distance < controller.settings.min_distance:
        pytest.skip(f"{robot.joint_names[joint]} there is in penetration too, which another test starts from")
    controller.reset(q)
    contract = Contract(controller, q)
    statuses = set()
    for _ in range(1500):
        reference = controller.step({}, 0.002)
        statuses.add(reference.report.status)
        contract.check(reference, 0.002)
    assert StepStatus.RECOVERING in statuses
    margin = controller.settings.position_margin
    assert robot.position_lower[joint] + margin <= reference.q[joint] <= robot.position_upper[joint] - margin


def test_started_in_penetration_it_separates_and_never_comes_closer() -> None:
    controller = iiwa7s()
    q, _ = in_penetration(controller.robot)
    contract = run(controller, crossing, 4.0, 0.002, q=q)
    assert contract.ticks == 2000
    assert min(pair.distance for pair in controller.robot.distances(controller.step({}, 0.001).q)) >= 0.02 - 1e-4


@pytest.mark.parametrize("share", [0.5, 1.0, 1.5], ids=["half the limit", "at the limit", "above the limit"])
def test_started_with_a_velocity_it_brakes_within_the_limits(share: float) -> None:
    controller = iiwa7s()
    for seed in range(5):
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=14)
        v = share * signs * controller.robot.velocity_limit
        q = 0.2 * controller.robot.home + np.array([0.0, -0.5, 0.0, -0.8, 0.0, 0.4, 0.0] * 2)
        contract = run(controller, lambda t, start: {}, 1.0, 0.002, q=q, v=0.3 * v if share < 1.5 else v)
        assert contract.uncertified == 0


def test_it_leaves_a_stretched_posture_in_little_more_than_the_time_the_acceleration_limit_needs() -> None:
    controller = iiwa7s()
    robot = controller.robot
    q = robot.home.copy()
    for arm in robot.arms.values():
        q[arm.joints] = [0.0, 0.9, 0.0, 0.0, 0.0, 0.0, 0.0]  # elbow and wrist straight: the Jacobian has lost rank
    controller.reset(q)
    contract = Contract(controller, q)
    goals = {arm: controller.tool_pose(arm) for arm in robot.arms}
    for side, pose in goals.items():
        pose.translation = pose.translation + 0.15 * _towards(robot, side, pose)
    time, error = 0.0, 1.0
    while error > 0.01 and time < 4.0:
        reference = controller.step(goals, 0.001)
        contract.check(reference, 0.001)
        time += 0.001
        error = max(
            float(np.linalg.norm(controller.tool_pose(arm).translation - pose.translation))
            for arm, pose in goals.items()
        )
    # The joint with the longest way, at full acceleration half of it and at full deceleration the other half.
    limit = robot.capped_acceleration(controller.settings.acceleration_limit)
    fastest = 2.0 * np.sqrt((np.abs(reference.q - q) / limit).max())
    assert time < 1.2 * fastest, (time, fastest)


def test_every_joint_keeps_the_smaller_one_of_its_own_limit_and_of_the_setting_and_uses_it() -> None:
    limits = {"A2": 1.5, "A3": 12.0, "A4": 4.0}
    cell = load_config("config/dual_iiwa7.yaml")
    arms = {side: arm.model_copy(update={"acceleration_limit": limits}) for side, arm in cell.arms.items()}
    robot = Robot.from_config(cell.model_copy(update={"arms": arms}))
    controller = CartesianController(robot, ControllerSettings(acceleration_limit=9.0))
    start = {arm: controller.tool_pose(arm) for arm in robot.arms}
    goals = {arm: pin.SE3(pose.rotation, pose.translation + np.array([-0.1, 0.0, 0.15])) for arm, pose in start.items()}
    accelerations, before = [], np.zeros(14)
    for _ in range(600):
        reference = controller.step(goals, 0.001)
        accelerations.append(np.maximum(np.abs(reference.a), np.abs(reference.v - before) / 0.001))
        before = reference.v
    largest = np.max(accelerations, axis=0)[:7]
    allowed = np.array([8.65, 1.5, 9.0, 4.0, 9.0, 9.0, 9.0])
    assert (largest <= allowed * (1.0 + 1e-9)).all()
    np.testing.assert_allclose(largest[[1, 3]], [1.5, 4.0])
    assert largest[5] > 4.0


def _towards(robot: Robot, arm: str, pose: pin.SE3) -> Array:
    """Unit vector from the tool towards its arm's shoulder."""
    base = np.array([0.0, 0.4 if arm == "left" else -0.4, 0.34])
    away: Array = base - pose.translation
    return away / np.linalg.norm(away)


def test_a_solver_that_never_answers_brings_the_arms_to_rest_along_the_certified_stop() -> None:
    robot = robot_of("iiwa7")
    faulty = FaultySolver(make_solver("daqp", 14, None))
    controller = CartesianController(robot, solver=faulty)
    controller.reset(robot.home)
    start = {arm: controller.tool_pose(arm) for arm in robot.arms}
    contract = Contract(controller, robot.home)
    for tick in range(300):
        faulty.fault = None if tick < 200 else "none"
        reference = controller.step(crossing(0.0, start), 0.002)
        contract.check(reference, 0.002, failed=tick >= 200)
        assert reference.report.certified
    assert not reference.v.any()


@pytest.mark.parametrize(
    "solver", ["daqp", pytest.param("osqp", marks=[pytest.mark.slow, pytest.mark.filterwarnings("ignore")])]
)
def test_every_solver_keeps_the_contract_and_tracks(solver: str) -> None:
    controller = CartesianController(robot_of("iiwa7"), ControllerSettings(solver=solver))
    contract = run(controller, crossing, 1.5, 0.005)
    assert contract.fallback_share < 0.01
    run(controller, circle, 2.0, 0.005)
    goal = circle(
        2.0 - 0.005, {arm: controller.robot.tool_pose(controller.robot.home, arm) for arm in ("left", "right")}
    )
    for arm, pose in goal.items():
        assert pose is not None
        assert np.linalg.norm(controller.tool_pose(arm).translation - pose.translation) < 0.005


def test_the_same_start_and_targets_give_the_same_motion_to_the_bit() -> None:
    controller = iiwa7s()
    runs = []
    for _ in range(2):
        controller.reset(controller.robot.home)
        start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
        runs.append([controller.step(crossing(0.0, start), 0.005).q for _ in range(100)])
    np.testing.assert_array_equal(runs[0], runs[1])


def test_the_report_names_what_holds_the_arms_back() -> None:
    controller = iiwa7s()
    controller.reset(controller.robot.home)
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    for _ in range(800):
        report = controller.step(SCENARIOS["into the table"](0.0, start), 0.005).report
    assert any("envelope" in name and "table" in name for name in map(limit_name, report.binding))
    assert "table" in "|".join(report.closest_pair)
    assert report.certified
    assert not report.fallback


@pytest.mark.slow
def test_separation_holds_between_ticks_and_along_every_stop_where_the_arms_come_nearest() -> None:
    """With the least buffer; Coal measures between all ticks, and along the full stop from each."""
    settings = ControllerSettings(distance_buffer=1e-4, separation_gain=20.0)
    controller = CartesianController(robot_of("iiwa7"), settings)
    contract = Contract(controller, sample_all=True)
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    for _ in range(500):
        contract.check(controller.step(crossing(0.0, start), settings.max_substep), settings.max_substep)
    for promise in ("distance", "between", "stop"):
        assert contract.margins[promise].checked == 500
        assert contract.margins[promise].worst < 3e-4, "the arms come near"
