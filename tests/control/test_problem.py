"""The QP of a step can be read without side effects. A program may solve it, and any solution keeps the contract."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import qpsolvers

from q2r2_control import CartesianController, ControllerSettings, MovingObstacle, Reference, RobotError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, StepStatus
from q2r2_control.verification.contract import Contract

DT = 0.002
KEPT = ControllerSettings(moving_obstacles=("hand",))


def crossing(robot: Robot, tick: int = 0) -> dict[str, pin.SE3]:
    """Return a target for each tool, at the home position of the other tool. The left target swings up and down."""
    left, right = (robot.tool_pose(robot.home, arm) for arm in ("left", "right"))
    swing = np.array([0.0, 0.0, 0.05 * math.sin(0.02 * tick)])
    return {
        "left": pin.SE3(left.rotation, right.translation + swing),
        "right": pin.SE3(right.rotation, left.translation),
    }


def same(one: Reference, other: Reference) -> bool:
    """Return whether two references and their reports are equal to the bit. The solve times are not compared."""
    arrays = all(np.array_equal(getattr(one, name), getattr(other, name)) for name in "qva")
    return arrays and replace(one.report, solve_time=0.0) == replace(other.report, solve_time=0.0)


def solved_by(name: str, problem: qpsolvers.Problem) -> Array | None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Some solvers warn because they want sparse matrices.
        x: Array | None = qpsolvers.solve_problem(problem, solver=name).x
    return x


def busy(controller: CartesianController, tick: int) -> None:
    """Change settings and move an obstacle between steps, so that some of the controller's values change with time."""
    if tick == 50:
        assert controller.change({"position_gain": 4.0, "min_distance": 0.025}) is None
    if tick % 25 == 5:
        shape: dict[str, Any] = {"shape": "sphere", "size": (0.05,), "speed": 0.2}
        pose = {"position": (0.9, 0.3 * math.sin(0.01 * tick), 0.6)}
        controller.move_obstacle("hand", MovingObstacle(**shape, **pose))


def test_reading_the_problem_does_not_change_a_run_in_any_bit(robot: Robot) -> None:
    read, unread = CartesianController(robot, KEPT), CartesianController(robot, KEPT)
    for tick in range(150):
        targets: Mapping[str, pin.SE3 | None] = crossing(robot, tick) if tick % 70 < 60 else {}
        dt = (DT, 0.005, 0.001)[tick // 50]
        for controller in (read, unread):
            busy(controller, tick)
        certified, stop, kept = read._certified, read.stop_deceleration, read.kept_distances
        read.problem(targets, dt)
        read.problem({"left": robot.tool_pose(robot.home, "left")}, 0.1, robot.home + 0.1)
        assert read._certified == certified
        assert read.kept_distances is kept
        np.testing.assert_array_equal(read.stop_deceleration, stop)
        assert same(read.step(targets, dt), unread.step(targets, dt)), tick


def test_the_problem_that_a_program_reads_is_the_problem_that_the_step_solves(robot: Robot) -> None:
    by_hand, controller = CartesianController(robot), CartesianController(robot)
    with_rows = 0
    for tick in range(200):
        targets = crossing(robot, tick)
        problem = by_hand.problem(targets, DT)
        with_rows += problem.G is not None
        x = solved_by("daqp", problem)
        reference, expected = by_hand.advance(x, targets, DT), controller.step(targets, DT)
        np.testing.assert_allclose(reference.v, expected.v, atol=1e-8)
        np.testing.assert_allclose(reference.q, expected.q, atol=1e-8)
        assert reference.report.binding == expected.report.binding
    assert with_rows > 100


def test_the_velocities_of_a_step_given_to_advance_lead_to_exactly_the_same_reference(robot: Robot) -> None:
    controllers = [CartesianController(robot) for _ in range(2)]
    for tick in range(200):
        targets = crossing(robot, tick)
        stepped = controllers[0].step(targets, DT)
        found = controllers[0]._solution.copy()
        assert same(controllers[1].advance(found, targets, DT), stepped), tick


NO_SOLUTION: tuple[Any, ...] = (
    *(None, "fast", 5.0, [], {}, object(), np.zeros(13), np.zeros((14, 1)), np.full(14, np.nan)),
    np.append(np.zeros(13), np.inf),
)


@pytest.mark.slow
@pytest.mark.parametrize("x", NO_SOLUTION, ids=lambda x: repr(x)[:12])
def test_after_an_invalid_solution_the_arms_brake_along_the_certified_stop_as_without_a_solution(
    robot: Robot, x: Any
) -> None:
    controller = CartesianController(robot)
    before = [controller.step(crossing(robot), DT) for _ in range(100)][-1]
    report = controller.advance(x, crossing(robot), DT).report
    assert (report.status, report.unsolved, report.certified) == (StepStatus.FALLBACK, 1, True)
    for _ in range(500):
        reference = controller.advance(x, crossing(robot), DT)
    assert np.abs(before.v).max() > 0.1
    assert not reference.v.any()


def test_given_velocities_far_beyond_the_velocity_box_never_break_the_contract(robot: Robot) -> None:
    controller, random = CartesianController(robot), np.random.default_rng(3)
    contract = Contract(controller, robot.home)
    for tick in range(400):
        x = random.normal(size=14) * 10.0 ** (tick % 7) + 50.0 * math.sin(0.02 * tick)
        contract.check(controller.advance(x, {}, DT), DT)


@pytest.mark.parametrize("dt", [0.0, -1.0, 0.11, math.nan, None, "a"])
def test_the_problem_of_a_step_with_an_invalid_dt_is_refused(robot: Robot, dt: Any) -> None:
    with pytest.raises(RobotError, match=r"dt = .*: allowed: a number above 0, up to 0\.1 s"):
        CartesianController(robot).problem({}, dt)
