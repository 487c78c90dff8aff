"""Where the cost's own minimum keeps every bound no solver is asked, and that changes nothing but the time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.control.kernel_model import KernelData, kernel_model_of
from q2r2_control.control.qp import DaqpSolver, QpProblem, QpSolution, SkipIfUnconstrained
from q2r2_control.control.qp_assembly import find_minimum
from q2r2_control.types import Array

CONFIG = load_config("config/dual_iiwa7.yaml")
SETTINGS = CONFIG.control.model_copy(update={"solve_time_limit": None})  # no outcome hangs on the clock
DT = 0.001


class BothWays:
    """Solves every problem in full, and notes how far the minimum that was found before is from that."""

    def __init__(self, nv: int) -> None:
        self._solver = DaqpSolver(nv, None)
        self.deviations: list[float] = []
        self.bound = 0  # problems without such a minimum
        self.held_back = 0  # of them, those in which a bound holds the solution back

    def solve(self, problem: QpProblem) -> QpSolution:
        solution = self._solver.solve(problem)
        assert solution.v is not None
        if problem.minimum is None:
            self.bound += 1
            self.held_back += bool(np.abs(solution.v + np.linalg.solve(problem.H, problem.g)).max() > 1e-9)
        else:
            self.deviations.append(float(np.abs(solution.v - problem.minimum).max()))
            assert (problem.lower <= problem.minimum).all()
            assert (problem.minimum <= problem.upper).all()
            assert (problem.rows @ problem.minimum >= problem.rows_lower - 1e-12).all()
        return solution


@pytest.fixture
def data() -> KernelData:
    """Of a cost whose minimum is 0.1 rad/s for every joint, in a box of 1 rad/s and with one row that it keeps."""
    robot = Robot.from_config(CONFIG)
    data, nv = KernelData.empty(kernel_model_of(robot, SETTINGS)), robot.model.nv
    root = np.random.default_rng(5).normal(size=(nv, nv))
    data.tasks.H[:] = root @ root.T + np.eye(nv)
    data.tasks.g[:] = -data.tasks.H @ np.full(nv, 0.1)
    data.safety.box.lower[:], data.safety.box.upper[:] = -1.0, 1.0
    data.safety.rows.matrix[0, 3], data.safety.rows.lower[0], data.safety.rows.used[0] = 1.0, 0.05, 1
    return data


def test_a_minimum_within_all_bounds_is_found(data: KernelData) -> None:
    assert find_minimum(data.safety, data.tasks)
    np.testing.assert_allclose(data.tasks.minimum, 0.1, atol=1e-12)


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
def test_one_bound_that_is_in_the_way_leaves_it_to_the_solver(
    data: KernelData, change: Callable[[KernelData], None]
) -> None:
    change(data)
    assert not find_minimum(data.safety, data.tasks)


def circling(home: pin.SE3, t: float, side: float) -> pin.SE3:
    """A tool that goes round and, farther on, into the other arm and out of it again."""
    pose = home.copy()
    pose.translation = home.translation + np.array(
        [0.08 * np.sin(4.0 * t), -side * 0.25 * (1.0 - np.cos(t)), 0.04 * np.sin(3.0 * t)]
    )
    return pose


def test_the_minimum_is_the_solution_wherever_it_is_one() -> None:
    robot = Robot.from_config(CONFIG)
    solver = BothWays(robot.model.nv)
    controller = CartesianController(robot, SETTINGS, solver=solver)
    home = {arm: controller.tool_pose(arm) for arm in robot.arms}
    solver.deviations.clear()
    solver.bound = solver.held_back = 0
    for tick in range(6000):
        targets = {arm: circling(home[arm], tick * DT, 1.0 if arm == "left" else -1.0) for arm in home}
        controller.step(targets, DT)
    assert len(solver.deviations) > 1000, "free on the way"
    assert solver.bound > 1000, "and held back by the other arm"
    assert max(solver.deviations) < 1e-8
    assert solver.held_back == solver.bound, "a solver is asked only where a bound matters"


def problem_of(minimum: Array | None) -> QpProblem:
    n = 3
    return QpProblem(np.eye(n), -np.ones(n), np.full(n, -2.0), np.full(n, 2.0), np.zeros((0, n)), np.zeros(0), minimum)


def test_a_solver_is_asked_only_where_there_is_no_such_minimum() -> None:
    asked: list[QpProblem] = []

    class Noting:
        def solve(self, problem: QpProblem) -> QpSolution:
            asked.append(problem)
            return DaqpSolver(3, None).solve(problem)

    solver, known = SkipIfUnconstrained(Noting()), np.ones(3)
    assert solver.solve(problem_of(known)).v is known
    assert not asked
    solution = solver.solve(replace(problem_of(known), minimum=None))
    assert len(asked) == 1
    assert solution.v is not None
    np.testing.assert_allclose(solution.v, known)
