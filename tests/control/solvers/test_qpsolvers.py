"""With every installed solver, the arms move as with DAQP. No solver prints anything or makes a step fail."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import qpsolvers

from q2r2_control import CartesianController
from q2r2_control.benchmark.solver_run import SOLVERS
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.qp import QpProblem
from q2r2_control.control.solvers import registry
from q2r2_control.control.solvers.registry import OURS, make_solver
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract
from tests.control.cells import cell
from tests.control.scenarios import crossing

DT = 0.002
ROBOT = cell("dual_iiwa7").robot
NV = ROBOT.model.nv
INSTALLED = [name for name in SOLVERS if name in (*OURS, *qpsolvers.available_solvers)]
FAR_M = 2e-3  # Largest distance of a tool from its position with DAQP. It allows for the errors of first-order solvers.


@contextmanager
def silence(capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """Fail if something is printed in the block, also by a library, or if there is a warning."""
    capfd.readouterr()  # Output from before the block is dropped: HiGHS prints a line when it is made.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    assert capfd.readouterr() == ("", "")


def _driven(controller: CartesianController, ticks: int) -> tuple[Array, int]:
    """Send the tools towards each other, and return the postures of the run and the number of unsolved ticks."""
    home = {arm: controller.tool_pose(arm) for arm in ROBOT.arms}
    contract, q, unsolved = Contract(controller), [], 0
    for tick in range(ticks):
        reference = controller.step(crossing(tick * DT, home), DT)
        contract.check(reference, DT)
        unsolved += reference.report.unsolved
        q.append(reference.q)
    return np.array(q), unsolved


def _problem(random: np.random.Generator, rows: int, hard: int = 0) -> QpProblem:
    J, matrix = random.normal(size=(12, NV)), random.normal(size=(rows, NV))
    matrix /= np.linalg.norm(matrix, axis=1, keepdims=True)
    H, wide, lower = J.T @ J + 0.1 * np.eye(NV), np.ones(NV), random.uniform(-1.0, 0.2, rows)
    return QpProblem(H, random.normal(size=NV), -wide, wide, matrix, lower, hard=hard)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in INSTALLED if name != "daqp"])
def test_arms_move_with_each_solver_as_they_move_with_daqp(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    chosen = CartesianController(ROBOT, ControllerSettings(), solver=name)
    with silence(capfd):
        q, unsolved = _driven(chosen, 250)
    expected, _ = _driven(CartesianController(ROBOT, ControllerSettings()), 250)
    assert unsolved == 0
    tools = [[[ROBOT.tool_pose(at, arm).translation for arm in ROBOT.arms] for at in run] for run in (q, expected)]
    assert np.abs(np.array(tools[0]) - np.array(tools[1])).max() < FAR_M
    assert np.abs(q[-1] - q[0]).max() > 0.1


@pytest.mark.parametrize("name", INSTALLED)
def test_a_problem_without_a_solution_counts_as_a_failed_solve_and_the_next_problem_is_solved(
    name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    solver, random = make_solver(name, NV), np.random.default_rng(2)
    against, usual = _problem(random, 2, hard=2), _problem(random, 20)
    against.rows[1] = -against.rows[0]
    against.rows_lower[:] = 0.5
    with silence(capfd):
        assert solver.solve(against).v is None
        found, expected = solver.solve(usual).v, make_solver("daqp", NV).solve(usual).v
    assert found is not None
    assert expected is not None
    np.testing.assert_allclose(found, expected, atol=5e-3)


@pytest.mark.parametrize("name", [name for name in INSTALLED if name not in OURS])
def test_a_row_that_every_velocity_satisfies_causes_no_message(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    solver = make_solver(name, NV)
    problem = _problem(np.random.default_rng(4), 5)
    problem.rows_lower[:3] = -1e11
    with silence(capfd):
        assert solver.solve(problem).v is not None


def test_texts_that_a_solver_prints_while_it_is_made_go_to_stderr(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Loud:
        def solve(self, problem: QpProblem) -> None:
            os.write(1, b"loud\n")

    monkeypatch.setattr(registry, "_made", lambda *given: Loud())
    make_solver("osqp", NV)
    os.write(1, b"result\n")
    assert capfd.readouterr() == ("result\n", "loud\n")


@pytest.mark.skipif("highs" not in INSTALLED, reason="HiGHS is not installed")
def test_a_solve_that_reaches_the_iteration_limit_counts_as_failed() -> None:
    problem = _problem(np.random.default_rng(5), 40)
    assert make_solver("highs", NV, options={"qp_iteration_limit": 1}).solve(problem).v is None
    assert make_solver("highs", NV).solve(problem).v is not None
