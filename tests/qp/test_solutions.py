"""The QP has one solution.

In small problems, every solver finds the solution that brute force finds. In motions, it finds the solution of DAQP.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import qpsolvers

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.qp import QpProblem, QpSolution, Solver, row_softness
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.control.solvers.qpsolvers import QpSolversSolver, slack_problem
from q2r2_control.control.solvers.registry import make_solver
from q2r2_control.types import Array
from tests.control.scenarios import crossing, into_the_table, overhead, teleport
from tests.control.test_scenarios import at_home, in_penetration, outside_its_limits, too_fast
from tests.qp.brute_force import cost_of, is_feasible, solve_by_brute_force
from tests.qp.solvers import EXACTLY, NAMES, ROBOT, accuracy_of, each_solver

DT, NV = 0.002, 4


@cache
def solver_of(name: str, nv: int) -> Solver:
    return make_solver(name, nv, options=EXACTLY.get(name))


def small(random: np.random.Generator, rows: list[list[float]], lower: list[float], hard: int = 0) -> QpProblem:
    """Return a problem of four joints with the given ``rows``. Without rows, its box is active for some joints."""
    J = random.normal(size=(3, NV))
    matrix = np.array(rows, dtype=float).reshape(-1, NV)
    matrix /= np.linalg.norm(matrix, axis=1, keepdims=True)
    H = J.T @ J + 0.01 * np.eye(NV)
    wide = np.array([0.2, 0.5, 1.0, 2.0])
    return QpProblem(H, H @ random.normal(size=NV), -wide, wide, matrix, np.array(lower), hard=hard)


def _boxed(random: np.random.Generator, lower: list[float], upper: list[float], *row: float) -> QpProblem:
    problem = small(random, [list(row)] if row else [], [0.1] if row else [])
    problem.lower[:], problem.upper[:] = lower, upper
    return problem


def _at_hardly_any_cost(random: np.random.Generator) -> QpProblem:
    problem = small(random, [[1, 1, 0, 0]], [0.3])
    J = random.normal(size=(1, NV))
    problem.H[:] = J.T @ J + 1e-3 * np.eye(NV)
    return problem


def corners() -> dict[str, QpProblem]:
    """Return special problems, for example without rows, with contradictory rows, or with only one allowed velocity."""
    random = np.random.default_rng(11)
    return {
        "no rows": small(random, [], []),
        "one row": small(random, [[1, 2, 0, -1]], [0.4]),
        "a row beyond the box": small(random, [[1, 0, 0, 0]], [5.0]),
        "two rows that contradict each other": small(random, [[1, 1, 0, 0], [-1, -1, 0, 0]], [0.3, 0.3]),
        "one row three times": small(random, [[0, 1, 1, 0]] * 3, [0.6] * 3),
        "all rows active": small(random, random.normal(size=(4, NV)).tolist(), [2.0, 3.0, 4.0, 5.0]),
        "more rows than joints": small(random, random.normal(size=(5, NV)).tolist(), [0.2] * 5),
        "one joint that must brake": _boxed(random, [0.1, -1, -1, -1], [0.1, 1, 1, 1], 1, -1, 0, 0),
        "no joint with a choice": _boxed(random, [0.1, -0.2, 0.0, 0.3], [0.1, -0.2, 0.0, 0.3], 1, -1, 0, 0),
        "a box that excludes rest": _boxed(random, [0.1, 0.2, -1, -1], [0.3, 0.4, 1, 1]),
        "a nearly flat cost": _at_hardly_any_cost(random),
        "a hard row": small(random, [[1, 0, 1, 0], [0, 1, 0, 1]], [0.5, 0.4], hard=1),
        "hard and soft rows that contradict": small(random, [[1, 1, 0, 0], [-1, -1, 0, 0]], [0.3, 0.1], hard=1),
        "a hard equality": small(random, [[0, 1, 1, 0], [0, -1, -1, 0]], [0.2, -0.2], hard=2),
    }


CORNERS = corners()


@cache
def brute_force(corner: str) -> Array:
    return solve_by_brute_force(CORNERS[corner])


def _assert_solved(solution: QpSolution, problem: QpProblem, expected: Array, accuracy: float) -> None:
    assert solution.v is not None
    found = np.clip(solution.v, problem.lower, problem.upper)
    np.testing.assert_allclose(solution.v, found, atol=accuracy)
    np.testing.assert_allclose(found, expected, atol=accuracy)
    assert is_feasible(problem, found, tolerance=accuracy)


@pytest.mark.parametrize("corner", CORNERS)
def test_no_other_feasible_point_costs_less_than_the_solution_of_brute_force(corner: str) -> None:
    problem, best = CORNERS[corner], brute_force(corner)
    random, least = np.random.default_rng(2), cost_of(problem, best)
    for size in (1e-3, 1e-2, 0.1, 1.0):
        for _ in range(200):
            other = np.clip(best + size * random.normal(size=NV), problem.lower, problem.upper)
            assert cost_of(problem, other) >= least - 1e-12 or not is_feasible(problem, other)


@pytest.mark.parametrize("corner", CORNERS)
@pytest.mark.parametrize("name", NAMES)
def test_a_solver_finds_the_solution_of_brute_force(name: str, corner: str) -> None:
    _assert_solved(solver_of(name, NV).solve(CORNERS[corner]), CORNERS[corner], brute_force(corner), accuracy_of(name))


@cache
def random_problems() -> list[tuple[QpProblem, Array]]:
    """Return problems with zero to three rows, with the solution of each."""
    random, found = np.random.default_rng(5), []
    for rows in (0, 1, 2, 3, 3, 3):
        lower = random.uniform(-0.5, 1.0, rows).tolist()
        problem = small(random, random.normal(size=(rows, NV)).tolist(), lower)
        found.append((problem, solve_by_brute_force(problem)))
    return found


@pytest.mark.parametrize("name", NAMES)
def test_a_solver_finds_the_brute_force_solutions_of_random_problems(name: str) -> None:
    for problem, expected in random_problems():
        _assert_solved(solver_of(name, NV).solve(problem), problem, expected, accuracy_of(name))


class Noting:
    """A solver that calls DAQP, and keeps every problem whose solution is not the minimum of its cost alone."""

    def __init__(self) -> None:
        self._solver, self.problems = DaqpSolver(ROBOT.model.nv), list[QpProblem]()

    def solve(self, problem: QpProblem) -> QpSolution:
        if problem.minimum is None:
            # The controller gives a copy of the problem to a solver of another package, so no further copy is made.
            self.problems.append(problem)
        return self._solver.solve(problem)


MOTIONS = {
    "targets that cross": (crossing, at_home),
    "targets below the table": (into_the_table, at_home),
    "arms stretched out": (overhead, at_home),
    "targets that jump": (teleport, at_home),
    "recovery from outside a limit": (crossing, outside_its_limits),
    "recovery from penetration": (crossing, in_penetration),
    "recovery from too high a speed": (crossing, too_fast),
}


@cache
def problems_of(motion: str) -> list[QpProblem]:
    """Return ten problems from 0.6 s of a motion, evenly spread among the problems that need a solver."""
    scenario, start = MOTIONS[motion]
    noting = Noting()
    controller = CartesianController(ROBOT, ControllerSettings(), solver=noting)
    controller.reset(*start(ROBOT))
    tools = {arm: controller.tool_pose(arm) for arm in ROBOT.arms}
    noting.problems.clear()
    for tick in range(300):
        controller.step(scenario(tick * DT, tools), DT)
    return [noting.problems[i] for i in np.linspace(0, len(noting.problems) - 1, 10).astype(int)]


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("name", each_solver()[1:])
def test_a_solver_finds_daqps_solution_of_each_problem_of_a_motion(name: str, motion: str) -> None:
    solver, daqp = solver_of(name, ROBOT.model.nv), solver_of("daqp", ROBOT.model.nv)
    for problem in problems_of(motion):
        expected = daqp.solve(problem).v
        assert expected is not None
        _assert_solved(solver.solve(problem), problem, expected, accuracy_of(name))


@pytest.mark.parametrize("name", NAMES)
def test_a_solver_finds_a_solution_if_the_box_hardly_allows_three_similar_rows(name: str) -> None:
    nv, up, unsolved = 7, np.full(7, 0.1), 0
    for seed in range(20):
        random = np.random.default_rng(seed)
        rows = random.normal(size=nv) + 0.1 * random.normal(size=(3, nv))
        rows /= np.linalg.norm(rows, axis=1)[:, None]
        # The rows demand about as much as the box allows.
        lower = 0.1 * np.abs(rows).sum(axis=1) * random.uniform(0.95, 1.05, 3)
        problem = QpProblem(300.0 * np.eye(nv), np.zeros(nv), -up, up, rows, lower)
        v = solver_of(name, nv).solve(problem).v
        unsolved += v is None
        if v is not None:
            assert (rows @ np.clip(v, -up, up) >= np.minimum(lower, 0.1 * np.abs(rows).sum(axis=1)) - 0.01).all()
    assert unsolved <= (2 if name == "osqp" else 0)


def test_daqp_called_through_qpsolvers_finds_the_same_solutions_as_daqp_called_directly() -> None:
    through, directly = QpSolversSolver("daqp"), solver_of("daqp", ROBOT.model.nv)
    for motion in MOTIONS:
        for problem in problems_of(motion):
            expected = directly.solve(problem).v
            assert expected is not None
            _assert_solved(through.solve(problem), problem, expected, 1e-8)


def test_slacks_of_the_public_problem_equal_the_violations_of_rows_and_have_the_same_cost() -> None:
    """The solution x = [v; s] of the problem that ``CartesianController.problem`` returns has the cost f(v)."""
    for motion in ("targets that cross", "recovery from penetration"):
        for problem in problems_of(motion):
            nv, public = len(problem.g), slack_problem(problem)
            x = qpsolvers.solve_problem(public, solver="daqp").x
            assert x is not None
            lacking = np.maximum(problem.rows_lower - problem.rows @ x[:nv], 0.0)
            np.testing.assert_allclose(x[nv:], lacking, atol=1e-8)
            public_cost = 0.5 * x @ public.P @ x + public.q @ x
            assert public_cost == pytest.approx(cost_of(problem, x[:nv]), rel=1e-6, abs=1e-9)


def test_in_the_motions_many_rows_are_active_at_once_and_some_are_violated() -> None:
    """If no row were active, the comparison of solvers would only cover the box."""
    pressed, gave_way = 0, 0
    for motion in ("targets that cross", "recovery from penetration"):
        for problem in problems_of(motion):
            v = solver_of("daqp", ROBOT.model.nv).solve(problem).v
            assert v is not None
            lacking = problem.rows_lower - problem.rows @ v
            pressed = max(pressed, int((lacking > -1e-9).sum()))
            gave_way += bool((lacking > 1e-9).any())
            assert (row_softness(problem.H, problem.rows) > 0.0).all()
    assert pressed >= 4
    assert gave_way >= 5
