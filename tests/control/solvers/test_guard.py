"""No solver can change the controller's arrays, and no solver makes a step raise an exception."""

from __future__ import annotations

import re
import time
from typing import Any

import numpy as np
import pytest

from q2r2_control import CartesianController
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.qp import QpProblem, QpSolution
from q2r2_control.control.solvers.guard import Guard
from q2r2_control.types import StepStatus
from tests.control.cells import cell
from tests.control.scenarios import crossing

DT = 0.002
ROBOT = cell("dual_iiwa7").robot
NV = ROBOT.model.nv


class Answering:
    """A solver that returns, or raises, the given answer."""

    def __init__(self, answer: Any) -> None:
        self.answer = answer

    def solve(self, problem: QpProblem) -> Any:
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


class Unreadable:
    """An answer whose velocities cannot be read."""

    solve_time = 0.0

    @property
    def v(self) -> Any:
        raise RuntimeError("not now")


ZEROS = np.zeros(NV)
NO_SOLUTIONS: dict[str, Any] = {
    "None in place of an answer": None,
    "None as velocities": QpSolution(None, 0.0),
    "one velocity too few": QpSolution(np.zeros(NV - 1), 0.0),
    "a column": QpSolution(np.zeros((NV, 1)), 0.0),
    "one number": QpSolution(np.float64(0.0), 0.0),  # type: ignore[arg-type]
    "a text": QpSolution("fast", 0.0),  # type: ignore[arg-type]
    "objects": QpSolution(np.array([None] * NV), 0.0),
    "complex numbers": QpSolution(np.zeros(NV, dtype=complex), 0.0),
    "NaN": QpSolution(np.full(NV, np.nan), 0.0),
    "one infinite velocity": QpSolution(np.r_[np.inf, np.zeros(NV - 1)], 0.0),
    "no solve time": QpSolution(ZEROS, None),  # type: ignore[arg-type]
    "a solve time that is NaN": QpSolution(ZEROS, float("nan")),
    "a text as solve time": QpSolution(ZEROS, "soon"),  # type: ignore[arg-type]
    "a solve time below zero": QpSolution(ZEROS, -1.0),
    "an exception": ValueError("not today"),
    "velocities that raise": Unreadable(),
}


@pytest.mark.parametrize("answer", NO_SOLUTIONS.values(), ids=NO_SOLUTIONS)
def test_an_answer_that_is_not_a_solution_counts_as_a_failed_solve_and_the_arms_stop(answer: Any) -> None:
    controller = CartesianController(ROBOT, ControllerSettings(), solver=Answering(answer))
    reference = controller.step({arm: controller.tool_pose(arm) for arm in ROBOT.arms}, DT)
    assert reference.report.unsolved == 1
    assert reference.report.status is StepStatus.FALLBACK
    assert reference.report.certified
    assert controller.solver_failure
    np.testing.assert_array_equal(reference.v, 0.0)


class Writer:
    """A solver that overwrites every limit that it gets with a huge value, and answers with huge velocities."""

    def solve(self, problem: QpProblem) -> QpSolution:
        problem.lower[:], problem.upper[:] = -1e6, 1e6
        problem.rows[:], problem.rows_lower[:] = 0.0, -1e6
        problem.H[:], problem.g[:] = np.nan, np.nan
        return QpSolution(np.full(NV, 1e6), 0.0)


def test_a_solver_that_writes_into_the_limits_changes_none_of_them() -> None:
    controller = CartesianController(ROBOT, ControllerSettings(), solver=Writer())
    home = {arm: controller.tool_pose(arm) for arm in ROBOT.arms}
    v = np.zeros(NV)
    for tick in range(200):
        reference = controller.step(crossing(tick * DT, home), DT)
        assert (np.abs(reference.v - v) <= 10.0 * DT + 1e-12).all(), "the acceleration limit"
        assert (np.abs(reference.v) <= ROBOT.velocity_limit + 1e-12).all()
        assert (ROBOT.position_lower <= reference.q).all()
        assert (reference.q <= ROBOT.position_upper).all()
        v = reference.v
    assert np.abs(v).max() > 0.0, "it moves the arms"


def test_a_solver_that_changes_its_answer_later_does_not_change_the_solution() -> None:
    kept = np.full(NV, 0.001)

    class Late:
        def solve(self, problem: QpProblem) -> QpSolution:
            return QpSolution(kept, 0.0)

    wide = np.ones(NV)
    answer = Guard(Late(), NV).solve(QpProblem(np.eye(NV), ZEROS, -wide, wide, np.empty((0, NV)), np.empty(0)))
    kept[:] = 5.0
    np.testing.assert_array_equal(answer.v, 0.001)


class UnprintableError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("nor this")


class Panic(BaseException):
    """An exception that is not derived from Exception, like exceptions of libraries in Rust."""


@pytest.mark.parametrize("error", [UnprintableError(), Panic("at the disco")], ids=["unprintable", "panic"])
def test_a_step_raises_no_exception_if_its_solver_raises_one(error: BaseException) -> None:
    controller = CartesianController(ROBOT, ControllerSettings(), solver=Raising(error))
    report = controller.step({arm: controller.tool_pose(arm) for arm in ROBOT.arms}, DT).report
    assert report.unsolved == 1
    assert type(error).__name__ in str(controller.solver_failure)


def test_ctrl_c_within_a_solver_ends_the_step() -> None:
    with pytest.raises(KeyboardInterrupt):
        Guard(Raising(KeyboardInterrupt()), NV).solve(problem_of(np.eye(NV), ZEROS))


class Raising:
    def __init__(self, error: BaseException) -> None:
        self.error = error

    def solve(self, problem: QpProblem) -> QpSolution:
        raise self.error


def problem_of(H: Any, g: Any) -> QpProblem:
    return QpProblem(H, g, -np.ones(NV), np.ones(NV), np.empty((0, NV)), np.empty(0))


@pytest.mark.parametrize(
    ("problem", "told"),
    [
        pytest.param(problem_of(np.eye(NV), np.full(NV, np.nan)), "not finite", id="NaN"),
        pytest.param(problem_of(np.eye(NV), np.full(NV, np.inf)), "not finite", id="infinite"),
        pytest.param(problem_of(1e200 * np.eye(NV), ZEROS), "above 1e\\+12", id="too large"),
        pytest.param(problem_of(-np.eye(NV), ZEROS), "not convex", id="not convex"),
        pytest.param(problem_of(1e-20 * np.eye(NV), ZEROS), "too flat", id="too flat"),
    ],
)
def test_no_solver_gets_a_problem_with_which_libraries_loop_for_ever(problem: QpProblem, told: str) -> None:
    guard = Guard(Raising(AssertionError("asked")), NV)
    assert guard.solve(problem).v is None
    assert re.search(told, str(guard.failure))


class Blocking:
    """A solver that finds a solution too late, and reports that it took no time."""

    def solve(self, problem: QpProblem) -> QpSolution:
        time.sleep(0.02)
        return QpSolution(np.zeros(NV), 0.0)


def test_a_solver_that_blocks_counts_as_late_whatever_it_reports() -> None:
    controller = CartesianController(ROBOT, ControllerSettings().timed(realtime=True), solver=Blocking())
    report = controller.step({"left": controller.tool_pose("left")}, DT).report
    assert report.unsolved == 1
    assert report.solve_time >= 0.02
