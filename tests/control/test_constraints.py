"""A program can add constraints, which become rows of the QP. Every step except the certified stop satisfies hard rows.

The contract holds whatever a constraint returns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import qpsolvers

from q2r2_control import CartesianController, ConfigError, Robot
from q2r2_control.control.qp import QpProblem
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.types import Array, LimitKind
from q2r2_control.verification.contract import Contract
from tests.control.test_problem import DT, crossing, solved_by


class StillJoint:
    """A constraint that keeps the next velocity of a joint at 0."""

    def __init__(self, joint: int, hard: bool = False) -> None:
        self.joint, self.hard = joint, hard

    def rows(self, q: Array, v: Array) -> tuple[Array, Array]:
        A = np.zeros((2, len(q)))
        A[0, self.joint], A[1, self.joint] = 3.0, -3.0  # The norm of the rows is arbitrary.
        return A, np.zeros(2)


class Answers:
    """A constraint that returns whatever ``answer`` returns once ``asked`` is True. Before that, it returns no rows."""

    def __init__(self, answer: Callable[[int], Any], hard: bool = False) -> None:
        self.answer, self.hard, self.asked = answer, hard, False

    def rows(self, q: Array, v: Array) -> Any:
        return self.answer(len(q)) if self.asked else (np.zeros((0, len(q))), np.zeros(0))


def raising(nv: int) -> Any:
    raise RuntimeError("two\nlines")


class UnprintableError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("nor this")


def unprintable(nv: int) -> Any:
    raise UnprintableError


NONSENSE: dict[str, Callable[[int], Any]] = {
    "an exception": raising,
    "an exception that cannot be printed": unprintable,
    "None": lambda nv: None,
    "one array": lambda nv: np.zeros((1, nv)),
    "another width": lambda nv: (np.zeros((1, nv + 1)), np.zeros(1)),
    "another length": lambda nv: (np.ones((1, nv)), np.zeros(2)),
    "text": lambda nv: ("a", "b"),
    "NaN": lambda nv: (np.full((1, nv), np.nan), np.zeros(1)),
    "too large": lambda nv: (np.full((1, nv), 1e300), np.zeros(1)),
    "zeros above 0": lambda nv: (np.zeros((1, nv)), np.ones(1)),
}


def driven(controller: CartesianController, ticks: int) -> tuple[Array, Array]:
    """Return velocities and postures of a run whose targets cross each other. The contract is checked at every tick."""
    contract = Contract(controller, controller.robot.home)
    v, q = [], []
    for tick in range(ticks):
        reference = controller.step(crossing(controller.robot, tick), DT)
        contract.check(reference, DT)
        v.append(reference.v)
        q.append(reference.q)
    return np.array(v), np.array(q)


@pytest.mark.parametrize(("hard", "most"), [(False, 1e-3), (True, 1e-6)], ids=["soft", "hard"])
def test_a_joint_that_must_not_turn_rests_while_the_other_joints_move(robot: Robot, hard: bool, most: float) -> None:
    free, _ = driven(CartesianController(robot), 400)
    held, _ = driven(CartesianController(robot, constraints=[StillJoint(3, hard)]), 400)
    assert np.abs(free[:, 3]).max() > 0.1
    assert np.abs(held[:, 3]).max() < most
    assert np.abs(held[:, 4]).max() > 0.1


class Plane:
    """A hard constraint that keeps the left elbow above a height [m]: J v+ >= -gain (z - height)."""

    hard = True

    def __init__(self, robot: Robot, height: float) -> None:
        self.model, self.data, self.height = robot.model, robot.model.createData(), height

    def elbow(self, q: Array) -> float:
        pin.computeJointJacobians(self.model, self.data, q)
        return float(self.data.oMi[4].translation[2])

    def rows(self, q: Array, v: Array) -> tuple[Array, Array]:
        room = self.elbow(q) - self.height
        J = pin.getJointJacobian(self.model, self.data, 4, pin.LOCAL_WORLD_ALIGNED)[2:3]
        return J, np.array([-5.0 * room])


def test_a_hard_constraint_keeps_an_elbow_above_a_plane_that_the_elbow_would_otherwise_cross(robot: Robot) -> None:
    _, q = driven(CartesianController(robot), 600)
    plane = Plane(robot, 0.0)
    heights = [plane.elbow(at) for at in q]
    plane.height = 0.5 * (heights[0] + min(heights))
    assert min(heights) < plane.height - 0.005
    _, q = driven(CartesianController(robot, constraints=[plane]), 600)
    assert min(plane.elbow(at) for at in q) > plane.height - 1e-4


def test_if_no_step_satisfies_a_hard_row_the_arms_brake_and_the_report_names_the_rows_constraint(robot: Robot) -> None:
    fast = Answers(lambda nv: (np.eye(nv)[:1], np.full(1, 100.0)), hard=True)
    controller = CartesianController(robot, constraints=[fast])
    moving, _ = driven(controller, 100)
    fast.asked = True
    for tick in range(400):
        reference = controller.step(crossing(robot, tick), DT)
        assert reference.report.fallback
        assert reference.report.certified
    assert np.abs(moving[-1]).max() > 0.1
    assert not reference.v.any()
    assert (LimitKind.CONSTRAINT, ("Answers",)) in reference.report.binding


def test_a_given_solution_that_violates_a_hard_row_is_not_executed(robot: Robot) -> None:
    controller = CartesianController(robot, constraints=[StillJoint(3, hard=True)])
    for tick in range(100):
        targets = crossing(robot, tick)
        x = solved_by("daqp", controller.problem(targets, DT))
        assert x is not None
        assert not controller.advance(x, targets, DT).report.unsolved
        x[3] = 0.01
        report = controller.advance(x, targets, DT).report
        assert report.fallback


class NoLess:
    """A constraint: in the direction of ``along`` (nv,), the next joint velocities are at least ``along``."""

    hard = True
    along: Array | None = None

    def rows(self, q: Array, v: Array) -> tuple[Array, Array]:
        if self.along is None:
            return np.zeros((0, len(q))), np.zeros(0)
        return self.along[None, :], np.array([self.along @ self.along])


def test_if_the_certified_part_of_a_solution_violates_a_hard_row_the_certified_stop_is_executed_exactly(
    robot: Robot,
) -> None:
    """The given solutions ignore all pairs, so that often only a part of a solution can be certified.

    This part is slower than the row allows. The arms then have to do exactly what they do without a solution.
    """
    constraints = NoLess(), NoLess()
    one, other = (CartesianController(robot, constraints=[constraint]) for constraint in constraints)
    daqp, contract, stops, follows = DaqpSolver(robot.model.nv), Contract(one), 0, 0
    nv = robot.model.nv
    for tick in range(250):
        targets = crossing(robot, tick)
        problem = one.problem(targets, DT)
        assert problem.lb is not None
        assert problem.ub is not None
        H, box = np.ascontiguousarray(problem.P[:nv, :nv]), (problem.lb[:nv], problem.ub[:nv])
        x = daqp.solve(QpProblem(H, problem.q[:nv], *box, np.empty((0, nv)), np.empty(0))).v
        assert x is not None
        for constraint in constraints:
            constraint.along = x
        reference = one.advance(x, targets, DT)
        contract.check(reference, DT)
        stopped = reference.report.fallback
        expected = other.advance(None if stopped else x, targets, DT)
        for found, wanted in zip(
            (reference.q, reference.v, reference.a, one.stop_deceleration),
            (expected.q, expected.v, expected.a, other.stop_deceleration),
            strict=True,
        ):
            np.testing.assert_array_equal(found, wanted)
        assert reference.report.certified == expected.report.certified
        assert reference.report.closest_distance == expected.report.closest_distance
        assert reference.report.binding == expected.report.binding
        stops, follows = stops + stopped, follows + (not stopped)
    assert stops > 25
    assert follows > 25


@pytest.mark.parametrize("name", [name for name in ("clarabel", "quadprog") if name in qpsolvers.available_solvers])
def test_solvers_other_than_daqp_also_keep_a_hard_row(robot: Robot, name: str) -> None:
    controller = CartesianController(robot, constraints=[StillJoint(3, hard=True)])
    stops = 0
    for tick in range(100):
        targets = crossing(robot, tick)
        reference = controller.advance(solved_by(name, controller.problem(targets, DT)), targets, DT)
        stops += reference.report.fallback
    assert stops == 0
    assert abs(reference.v[3]) < 1e-4


def test_osqp_keeps_a_hard_row_in_a_closed_loop_too(robot: Robot) -> None:
    controller = CartesianController(robot, solver="osqp", constraints=[StillJoint(3, hard=True)])
    reports = [controller.step(crossing(robot, tick), DT).report for tick in range(200)]
    assert sum(report.fallback for report in reports) < 2
    assert abs(controller.step(crossing(robot), DT).v[3]) < 1e-4


@pytest.mark.parametrize("hard", [False, True], ids=["soft", "hard"])
@pytest.mark.parametrize("name", NONSENSE)
def test_an_invalid_answer_of_a_constraint_raises_no_exception_and_the_report_names_the_constraint(
    robot: Robot, name: str, hard: bool
) -> None:
    broken = Answers(NONSENSE[name], hard)
    controller = CartesianController(robot, constraints=[broken])
    driven(controller, 50)
    broken.asked = True
    reference = controller.step(crossing(robot), DT)
    (fault,) = reference.report.faults
    assert fault.startswith("constraints[0] Answers: rows r")
    assert "\n" not in fault
    assert reference.report.fallback is hard, "a hard one brakes, a soft one asks for nothing"


class BrokenTask:
    asked = False

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        if self.asked:
            raise ZeroDivisionError
        return np.zeros((len(q), len(q))), np.zeros(len(q))


def test_a_task_that_raises_an_exception_in_a_step_changes_nothing_and_is_named_in_the_report(robot: Robot) -> None:
    task = BrokenTask()
    controllers = CartesianController(robot, tasks=[task]), CartesianController(robot)
    task.asked = True
    broken, usual = (controller.step(crossing(robot), DT) for controller in controllers)
    np.testing.assert_array_equal(broken.v, usual.v)
    assert broken.report.faults == ("tasks[0] BrokenTask: cost raised ZeroDivisionError: ",)


class NothingToKeep:
    """A constraint with a single row, which every velocity satisfies."""

    hard = True

    def rows(self, q: Array, v: Array) -> tuple[Array, Array]:
        return np.zeros((1, len(q))), np.zeros(1)


def test_a_row_of_zeros_with_the_bound_0_is_accepted_and_changes_nothing(robot: Robot) -> None:
    free, kept = CartesianController(robot), CartesianController(robot, constraints=[NothingToKeep()])
    for tick in range(20):
        reference = kept.step(crossing(robot, tick), DT)
        assert reference.report.faults == ()
        np.testing.assert_array_equal(reference.q, free.step(crossing(robot, tick), DT).q)


class Heavy:
    """A task whose matrix changes after the task was accepted at home."""

    def __init__(self, matrix: Callable[[int], Array]) -> None:
        self.matrix, self.asked = matrix, False

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        n = len(q)
        return (self.matrix(n) if self.asked else np.eye(n)), np.zeros(n)


@pytest.mark.parametrize(
    ("matrix", "told"),
    [
        (lambda n: -np.eye(n), "returned a matrix that is not positive semidefinite"),
        # No entry is negative, but a difference of two neighbouring joints has a negative cost.
        (
            lambda n: np.eye(n) + 2.0 * (np.eye(n, k=1) + np.eye(n, k=-1)),
            "returned a matrix that is not positive semidefinite",
        ),
        (lambda n: np.eye(n) + np.triu(np.full((n, n), 0.01), 1), "returned a matrix that is not symmetric"),
    ],
    ids=["negative", "indefinite", "not symmetric"],
)
def test_a_task_with_an_unusable_matrix_is_not_used_and_is_named_in_the_report(
    robot: Robot, matrix: Callable[[int], Array], told: str
) -> None:
    task = Heavy(matrix)
    controller = CartesianController(robot, tasks=[task])
    task.asked = True
    assert controller.step(crossing(robot), DT).report.faults == (f"tasks[0] Heavy: cost {told}",)
    with pytest.raises(ConfigError, match=told):
        CartesianController(robot, tasks=[task])


class NoSolver:
    """A solver whose answer is not a QpSolution."""

    def solve(self, problem: QpProblem) -> Any:
        return np.zeros(len(problem.g))


def test_a_solver_with_an_invalid_answer_is_named_in_the_report_and_a_solver_class_is_refused(robot: Robot) -> None:
    controller = CartesianController(robot, solver=NoSolver())
    report = controller.step(crossing(robot), DT).report
    assert report.unsolved
    (fault,) = report.faults
    assert fault.startswith("solver: AttributeError")
    with pytest.raises(ConfigError, match=r"solver = <class .*NoSolver'>: allowed: a solver's name, a Solver"):
        CartesianController(robot, solver=NoSolver)  # type: ignore[arg-type]


def test_the_report_names_unusable_targets_and_says_which_targets_are_allowed(robot: Robot) -> None:
    controller = CartesianController(robot)
    pose = controller.tool_pose("left")
    beyond = pin.SE3(pose.rotation, np.array([np.nan, 0.0, 0.0]))
    wrong: Any = {"left": pose.homogeneous, "right": beyond, "lefft": pose}
    report = controller.step(wrong, DT).report
    assert report.rejected == ("left", "right", "lefft")
    assert report.faults == (
        "target of left is of the type ndarray; allowed: a pinocchio.SE3, or None",
        "target of right: allowed: finite numbers and a rotation",
        "target of 'lefft': no such arm; allowed: left, right",
    )


@pytest.mark.parametrize(
    ("parts", "told"),
    [
        ({"tasks": 5}, "tasks = 5: allowed: a list of objects with a method cost"),
        ({"tasks": [StillJoint(0)]}, r"tasks\[0\] = .*: allowed: an object with a method cost"),
        ({"tasks": [BrokenTask]}, r"tasks\[0\] = .*: allowed: an object with a method cost"),
        ({"constraints": [BrokenTask()]}, r"constraints\[0\] = .*: allowed: an object with a method rows"),
        ({"constraints": [StillJoint(0, hard=2)]}, "hard = True or False"),  # type: ignore[arg-type]
        ({"constraints": [StillJoint(99)]}, r"constraints\[0\]: StillJoint.rows raised IndexError"),
    ],
)
def test_a_task_or_constraint_that_is_invalid_at_the_home_posture_is_refused(
    robot: Robot, parts: Any, told: str
) -> None:
    with pytest.raises(ConfigError, match=told):
        CartesianController(robot, **parts)
