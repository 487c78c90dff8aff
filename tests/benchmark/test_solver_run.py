"""The comparison of solvers measures DAQP and each installed solver in one motion, and names missing solvers."""

from __future__ import annotations

from dataclasses import replace

import pytest

from q2r2_control.benchmark import solver_run
from q2r2_control.benchmark.solver_run import CONTACT, run_solvers
from q2r2_control.cli.bench import solver_table
from q2r2_control.config.cell_file import load_config
from q2r2_control.control.qp import QpProblem, QpSolution

CONFIG = load_config("config/dual_iiwa7.yaml")
SHORT = replace(CONTACT, duration=0.3)


def test_each_solver_runs_the_motion_of_daqp_and_a_missing_solver_is_named() -> None:
    report = run_solvers(CONFIG, ("osqp", "no_such_solver"), motion=SHORT)
    daqp, osqp = report.figures
    assert (daqp.solver, daqp.off_daqp_mm, daqp.unsolved_percent) == ("daqp", 0.0, 0.0)
    assert (osqp.solver, osqp.unsolved_percent) == ("osqp", 0.0)
    assert osqp.off_daqp_mm is not None
    assert 1e-6 < osqp.off_daqp_mm < 1.0
    assert None not in (osqp.motion.times_us, osqp.motion.min_distance_mm, osqp.motion.rest_acceleration)
    assert report.missing == ["no_such_solver"]
    caption = str(solver_table(report).caption)
    assert "not installed: no_such_solver; pip install 'qpsolvers[open-source-solvers]'" in caption


def test_ticks_without_a_solution_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    class Never:
        def solve(self, problem: QpProblem) -> QpSolution:
            return QpSolution(None, 0.0)

    monkeypatch.setattr("q2r2_control.control.controller.solver_of", lambda *given: Never())
    monkeypatch.setattr(solver_run, "check_installed", lambda name: None)
    (never,) = run_solvers(CONFIG, (), motion=SHORT).figures
    assert never.unsolved_percent == 100.0
    assert never.motion.rest_acceleration == 0.0
