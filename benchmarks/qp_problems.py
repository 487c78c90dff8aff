"""How many of the controller's problems does each QP solver solve, by the criteria of the public qpbenchmark?

This file writes the QPs of 2,000 ticks, in which arms move freely, press against each other, run into limits and
recover. It then prints qpbenchmark's success rates of the installed solvers. The command ``qpbenchmark --results-path
build/qp_problems.csv benchmarks/qp_problems.py run`` solves the same problems, with reports and plots.
Both need ``pip install -e '.[bench]'``.

A problem is solved if the largest primal residual, dual residual and duality gap are below the tolerance of the
settings: 1 (default), 1e-3, 1e-6 and 1e-9. ``CartesianController.problem`` makes the problems, with a slack for each
row. Each solver gets them through qpsolvers. OSQP is therefore set up again for every problem, and DAQP is not called
directly.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas
import pinocchio as pin
import qpbenchmark
import qpsolvers
import typer
from qpbenchmark.parquet_test_set import ParquetTestSet
from qpbenchmark.problem_list import ProblemList
from qpbenchmark.utils import time_solve_problem
from rich.table import Table

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.control.solvers.registry import printing_to_stderr
from q2r2_control.types import Array
from q2r2_control.viewer.tables import figure_table

FILE = Path("build/qp_problems.parquet")
TICKS, SOLVED_PROBLEMS = 2000, 200
DT = 0.002  # Period of a tick [s].
_TICKS_PER_RECOVERY = 50  # Number of ticks from one posture outside the limits to the next.
Targets = dict[str, pin.SE3]
Motion = Callable[[float, Mapping[str, pin.SE3]], Targets]


class QpProblems(ParquetTestSet):
    """The problems in the file ``path``. qpbenchmark looks for a class of this name."""

    title = "Two arms of a QP controller"
    description = "QPs of differential inverse kinematics of two KUKA iiwa 7 that keep limits and distances."
    sparse_only = False

    def __init__(self, path: Path = FILE) -> None:
        super().__init__(path)


def moved(start: Mapping[str, pin.SE3], *by: float) -> Targets:
    """Return the tool poses at the start, each shifted along the world's x, y and z by the three numbers ``by`` [m]."""
    return {arm: pin.SE3(pose.rotation, pose.translation + np.array(by)) for arm, pose in start.items()}


def freely(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """Return targets that go round a circle in free air."""
    return moved(start, 0.0, 0.1 * math.sin(math.pi * t), 0.1 - 0.1 * math.cos(math.pi * t))


def pressing(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """Return targets that swing up and down around the position of the other tool at the start."""
    left, right = start["left"], start["right"]
    swing = np.array([0.0, 0.0, 0.1 * math.sin(math.tau * t)])
    return {
        "left": pin.SE3(left.rotation, right.translation + swing),
        "right": pin.SE3(right.rotation, left.translation - swing),
    }


def out_of_reach(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """Return targets that jump every quarter of a second, often to positions that the tools cannot reach."""
    random = np.random.default_rng(int(4.0 * t))
    places = {arm: random.uniform([-0.5, -1.5, -0.6], [2.0, 1.5, 1.5]) for arm in start}
    turns = {arm: pin.exp3(random.normal(size=3)) for arm in start}
    return {arm: pin.SE3(turns[arm] @ pose.rotation, pose.translation + places[arm]) for arm, pose in start.items()}


MOTIONS: dict[str, Motion] = {"free": freely, "contact": pressing, "limits": out_of_reach, "recovery": freely}


def outside(robot: Robot, random: np.random.Generator) -> Array:
    """Return a random posture (nv,) [rad]. One joint is 0.05 rad beyond its limit, and links may overlap."""
    q = random.uniform(robot.position_lower, robot.position_upper)
    joint = random.integers(robot.model.nv)
    q[joint] = robot.position_upper[joint] + 0.05
    return np.asarray(q)


def problems(ticks: int) -> Iterator[qpbenchmark.Problem]:
    """Yield the problem of every tick. Each of ``MOTIONS`` has the same number of ticks."""
    robot = Robot.from_config(load_config(DEMO_CONFIG))
    controller, random = CartesianController(robot), np.random.default_rng(1)
    start = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    for name, motion in MOTIONS.items():
        controller.reset(robot.home)
        for tick in range(ticks // len(MOTIONS)):
            if name == "recovery" and tick % _TICKS_PER_RECOVERY == 0:
                controller.reset(outside(robot, random))
            targets = motion(tick * DT, start)
            yield qpbenchmark.Problem.from_qpsolvers(controller.problem(targets, DT), f"{name}_{tick:04d}")
            controller.step(targets, DT)


def write(path: Path, ticks: int) -> None:
    """Write the problems of a number of ``ticks`` into a file that :class:`QpProblems` can read."""
    found = ProblemList()
    for problem in problems(ticks):
        found.append(problem)
    path.parent.mkdir(parents=True, exist_ok=True)
    found.to_parquet(str(path))


def solve(test_set: QpProblems, count: int) -> qpbenchmark.Results:
    """Return the results of all installed solvers and settings for ``count`` problems, evenly spread over the set."""
    total = test_set.count_problems()
    chosen = set(np.linspace(0, total - 1, min(count, total)).astype(int).tolist())
    rows: list[dict[str, Any]] = []
    for index, problem in enumerate(test_set):
        if index not in chosen:
            continue
        if len(rows) % 20 == 0:
            print_progress(f"{problem.name} of {total} problems")
        for solver in sorted(test_set.solvers):
            for settings, by_solver in test_set.solver_settings.items():
                rows.append(_row(problem, solver, settings, by_solver[solver]))
    results = qpbenchmark.Results(None, test_set)
    # All rows are added at once, because ``update`` copies all earlier rows for each new row.
    results.df = pandas.DataFrame(rows)
    return results


def _row(problem: qpbenchmark.Problem, solver: str, settings: str, options: Mapping[str, Any]) -> dict[str, Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Some solvers warn that they convert dense matrices to sparse ones.
        solution, runtime = time_solve_problem(problem, solver, **options)
    return {
        "problem": problem.name,
        "solver": solver,
        "settings": settings,
        "runtime": runtime,
        "found": bool(solution.found),
        "primal_residual": solution.primal_residual(),
        "dual_residual": solution.dual_residual(),
        "duality_gap": solution.duality_gap(),
    }


def success_rates(results: qpbenchmark.Results) -> pandas.DataFrame:
    """Return the percentage of solved problems by solver and settings, as it is in qpbenchmark's reports."""
    tolerances = results.test_set.tolerances
    by_kind = [
        {name: getattr(tolerance, kind) for name, tolerance in tolerances.items()} for kind in ("primal", "dual", "gap")
    ]
    return results.build_success_rate_df(*by_kind)


def table_of(results: qpbenchmark.Results, ticks: int, solved: int) -> Table:
    """Return the table of success rates, with the median time of a solve with default settings."""
    rates = success_rates(results)
    default = results.df[results.df["settings"] == "default"]
    median = 1e6 * default.groupby("solver")["runtime"].median()
    order = ("default", "low_accuracy", "mid_accuracy", "high_accuracy")
    return figure_table(
        f"QPs of {ticks} ticks, {solved} of them solved",
        ("solver", "default [%]", "1e-3 [%]", "1e-6 [%]", "1e-9 [%]", "median [us]"),
        [(solver, *(float(rates.at[solver, name]) for name in order), float(median[solver])) for solver in rates.index],
        (
            "default, 1e-3, 1e-6, 1e-9: Share of problems whose primal and dual residuals and duality gap are below "
            "this tolerance. The tolerance of default is 1.",
            "median: Median time of a solve with default settings.",
        ),
    )


def main(
    ticks: Annotated[int, typer.Option(min=4, help="Number of ticks whose QPs are written.")] = TICKS,
    solved: Annotated[int, typer.Option(min=1, help="Number of problems to solve, evenly spread.")] = SOLVED_PROBLEMS,
    file: Annotated[Path, typer.Option(help="The file to which the test set is written.")] = FILE,
    json: Json = False,
) -> None:
    """Write the test set, solve a part of it with every installed solver, and print the success rates."""
    print_progress(f"{ticks} ticks")
    write(file, ticks)
    with printing_to_stderr():
        results = solve(QpProblems(file), solved)
    count = int(results.df["problem"].nunique())
    data = {
        "file": str(file),
        "ticks": ticks,
        "solved": count,
        "qpbenchmark": qpbenchmark.__version__,
        "qpsolvers": qpsolvers.__version__,
        "success_percent": success_rates(results).to_dict("index"),
    }
    print_report(data, (table_of(results, ticks, count),), json)


if __name__ == "__main__":
    typer.run(main)
