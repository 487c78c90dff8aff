"""DAQP finds the minimum of the soft problem. It is called only if the minimum of the cost alone violates a bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.cholesky import factorise, substitute
from q2r2_control.control.kernel_model import KernelData
from q2r2_control.control.kernel_pointers import pointer_to
from q2r2_control.control.qp import SOFTNESS, QpProblem, QpSolution, find_minimum
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.types import Array
from tests.control.cells import cell, kernel_data

NV = 14


def _problem(random: np.random.Generator, rows: int, conflicting: bool = False) -> QpProblem:
    J = random.normal(size=(12, NV))
    middle, width = random.normal(size=NV) * 0.3, random.uniform(0.02, 1.0, NV)
    matrix = random.normal(size=(rows, NV))
    matrix /= np.linalg.norm(matrix, axis=1, keepdims=True)
    lower = random.uniform(-1.0, 0.2, rows)
    if conflicting:
        matrix, lower = np.vstack([matrix, -matrix]), np.concatenate([lower, 0.3 - lower])
    return QpProblem(J.T @ J + 1e-3 * np.eye(NV), random.normal(size=NV), middle - width, middle + width, matrix, lower)


def _assert_minimum(problem: QpProblem, v: Array) -> None:
    """Assert that ``v`` is the minimum. Without slack variables, the soft problem is a convex function in a box.

    ``v`` is its minimum if a step along the negative gradient, scaled by the curvature and clipped to the box, leads
    back to ``v``.
    """
    softness = SOFTNESS * np.sum(problem.rows * np.linalg.solve(problem.H, problem.rows.T).T, axis=1)
    slack = np.maximum(problem.rows_lower - problem.rows @ v, 0.0)
    gradient = problem.H @ v + problem.g - problem.rows.T @ (slack / softness)
    active = problem.rows[slack > 0.0]
    curvature = problem.H + active.T @ (active / softness[slack > 0.0, None])
    step = gradient / np.linalg.norm(curvature, 2)
    assert np.abs(v - np.clip(v - step, problem.lower, problem.upper)).max() < 1e-6


def _solved(solver: DaqpSolver, problem: QpProblem) -> Array:
    solution = solver.solve(problem)
    assert solution.v is not None
    assert solution.solve_time >= 0.0
    return solution.v


def test_the_minimum_is_found_for_any_number_of_rows_in_successive_ticks_even_if_rows_conflict() -> None:
    random, solver = np.random.default_rng(30), DaqpSolver(NV)
    for rows, conflicting in ((0, False), (5, False), (4, True), (0, False), (17, False), (3, False), (60, False)):
        for _ in range(5):
            problem = _problem(random, rows, conflicting)
            _assert_minimum(problem, _solved(solver, problem))


@pytest.mark.parametrize("scale", [1e-3, 1e3], ids="cost times {:g}".format)
def test_a_single_row_is_violated_by_the_same_fraction_for_any_weight_of_the_cost(scale: float) -> None:
    row = np.zeros((1, NV))
    row[0, :2] = 0.6, 0.8
    wide = np.full(NV, 10.0)
    problem = QpProblem(scale * np.eye(NV), np.zeros(NV), -wide, wide, row, np.ones(1))
    assert 1.0 - float((row @ _solved(DaqpSolver(NV), problem))[0]) == pytest.approx(1e-5, rel=0.1)


@pytest.mark.parametrize("what", ["g", "H", "rows"])
def test_numbers_that_are_not_finite_raise_no_exception_and_do_not_change_later_solutions(what: str) -> None:
    problem, solver = _problem(np.random.default_rng(32), 3), DaqpSolver(NV)
    before = _solved(solver, problem)
    broken = getattr(problem, what).copy()
    broken.flat[0] = np.nan
    solver.solve(replace(problem, **{what: broken}))
    np.testing.assert_allclose(_solved(solver, problem), before, atol=1e-6)


@pytest.fixture
def data() -> KernelData:
    """Return data with a cost whose minimum is 0.1 rad/s for every joint. The box of 1 rad/s and the row allow it."""
    data = kernel_data("dual_iiwa7", np.zeros(NV))
    root = np.random.default_rng(5).normal(size=(NV, NV))
    data.tasks.H[:] = root @ root.T + np.eye(NV)
    data.tasks.g[:] = -data.tasks.H @ np.full(NV, 0.1)
    data.safety.box.lower[:], data.safety.box.upper[:] = -1.0, 1.0
    data.safety.rows.matrix[0, 3], data.safety.rows.lower[0], data.safety.rows.used[0] = 1.0, 0.05, 1
    return data


def _lower(data: KernelData) -> None:
    data.safety.box.lower[5] = 0.2


def _upper(data: KernelData) -> None:
    data.safety.box.upper[13] = 0.0


def _row(data: KernelData) -> None:
    data.safety.rows.lower[0] = 0.11


def _not_finite(data: KernelData) -> None:
    data.tasks.g[2], data.safety.rows.used[0] = np.nan, 0


def _infinite(data: KernelData) -> None:
    data.safety.box.upper[:], data.tasks.g[0], data.safety.rows.used[0] = np.inf, -np.inf, 0


def _flat(data: KernelData) -> None:
    data.tasks.H[4], data.tasks.H[:, 4] = 0.0, 0.0


@pytest.mark.parametrize("change", [_lower, _upper, _row, _not_finite, _infinite, _flat])
def test_a_minimum_within_all_bounds_is_found_directly_and_otherwise_the_solver_is_called(
    data: KernelData, change: Callable[[KernelData], None]
) -> None:
    assert find_minimum(pointer_to(data))
    np.testing.assert_allclose(data.tasks.minimum, 0.1, atol=1e-12)
    change(data)
    assert not find_minimum(pointer_to(data))


class BothWays:
    """A solver that solves every problem in full, and records the difference from the direct minimum."""

    def __init__(self) -> None:
        self._solver = DaqpSolver(NV)
        self.deviations: list[float] = []
        # For each problem without a direct minimum: True if the solution differs from the minimum of the cost alone.
        self.held_back: list[bool] = []

    def solve(self, problem: QpProblem) -> QpSolution:
        solution = self._solver.solve(replace(problem, minimum=None))
        assert solution.v is not None
        if problem.minimum is None:
            free = np.linalg.solve(problem.H, problem.g)
            self.held_back.append(bool(np.abs(solution.v + free).max() > 1e-9))
        else:
            assert self._solver.solve(problem).v is problem.minimum, "DAQP is not asked"
            self.deviations.append(float(np.abs(solution.v - problem.minimum).max()))
        return solution


def circling(home: pin.SE3, t: float, side: float) -> pin.SE3:
    """Return a target at the time ``t`` [s]. It moves in small loops, and slowly into the other arm and out again."""
    by = np.array([0.08 * np.sin(4.0 * t), -side * 0.25 * (1.0 - np.cos(t)), 0.04 * np.sin(3.0 * t)])
    return pin.SE3(home.rotation, home.translation + by)


@pytest.mark.slow
def test_whenever_a_direct_minimum_exists_it_equals_the_solution_of_the_full_problem() -> None:
    robot, solver = cell("dual_iiwa7").robot, BothWays()
    controller = CartesianController(robot, ControllerSettings(), solver=solver)
    home = {arm: controller.tool_pose(arm) for arm in robot.arms}
    solver.deviations.clear()
    solver.held_back.clear()
    for tick in range(3000):
        targets = {arm: circling(home[arm], tick * 0.002, 1.0 if arm == "left" else -1.0) for arm in home}
        controller.step(targets, 0.002)
    assert len(solver.deviations) > 500, "free on the way"
    assert len(solver.held_back) > 500, "and held back by the other arm"
    assert max(solver.deviations) < 1e-8
    assert all(solver.held_back), "a solver is asked only where a bound matters"


RANDOM = np.random.default_rng(4)


@pytest.mark.parametrize("n", [1, 6, 14])
def test_a_matrix_given_by_its_upper_triangle_is_factorised_and_solves_equations(n: int) -> None:
    vectors, _ = np.linalg.qr(RANDOM.normal(size=(n, n)))
    A, b = (vectors * np.geomspace(1.0, 1e4, n)) @ vectors.T, RANDOM.normal(size=n)
    factor, x = np.triu(A), b.copy()
    assert factorise(factor)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(A), atol=1e-9)
    substitute(factor, x)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), atol=1e-9)


@pytest.mark.parametrize(
    "A", [np.diag([1.0, -1e-9, 2.0]), np.ones((3, 3)), np.full((3, 3), np.nan)], ids=["indefinite", "singular", "nan"]
)
def test_a_matrix_that_is_not_positive_definite_has_no_factor(A: np.ndarray) -> None:
    assert not factorise(A)
