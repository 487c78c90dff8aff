"""A program that uses only public names solves the QP by itself."""

from __future__ import annotations

import numpy as np
import pytest
import qpsolvers

from q2r2_control import (
    CartesianController,
    Config,
    Constraint,
    ControllerSettings,
    LookAt,
    QpProblem,
    QpSolution,
    Robot,
    Solver,
    Task,
    load_config,
)

Numbers = np.ndarray
ANY = next(name for name in ("clarabel", "quadprog", "daqp") if name in qpsolvers.available_solvers)


class Slowly:
    """A task that adds a cost on every joint's speed."""

    def cost(self, q: Numbers, v: Numbers) -> tuple[Numbers, Numbers]:
        return 0.01 * np.eye(len(q)), np.zeros(len(q))


class NotBackwards:
    """A constraint with which the left tool does not move backwards along the world's x axis."""

    hard = True

    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    def rows(self, q: Numbers, v: Numbers) -> tuple[Numbers, Numbers]:
        step, here = 1e-6, self.robot.tool_pose(q, "left").translation[0]
        ahead = [self.robot.tool_pose(q + step * one, "left").translation[0] for one in np.eye(len(q))]
        return (np.array([ahead]) - here) / step, np.zeros(1)


class OwnSolver:
    """A solver that ignores all rows and uses projected gradients. The certificate needs no better solver."""

    def solve(self, problem: QpProblem) -> QpSolution:
        v = np.clip(np.zeros_like(problem.g), problem.lower, problem.upper)
        for _ in range(50):
            v = v - (problem.H @ v + problem.g) / np.linalg.norm(problem.H, 2)
            v = np.clip(v, problem.lower, problem.upper)
        return QpSolution(v, 0.0)


@pytest.fixture(scope="module")
def cell() -> Config:
    return load_config("config/dual_iiwa7.yaml")


@pytest.mark.slow
def test_a_user_program_adds_a_task_and_a_constraint_and_solves_the_qp_with_its_own_solver(cell: Config) -> None:
    robot = Robot.from_config(cell)
    tasks: list[Task] = [LookAt(robot, (0.7, 0.0, 0.2), arms=["right"]), Slowly()]
    forwards = NotBackwards(robot)
    constraints: list[Constraint] = [forwards]
    settings = ControllerSettings(rotation_weights=(0.1, 0.1, 0.1))
    controller = CartesianController(robot, settings, solver="osqp", tasks=tasks, constraints=constraints)
    goals = {arm: controller.tool_pose(arm) for arm in robot.arms}
    for pose in goals.values():
        pose.translation = pose.translation + np.array([-0.1, 0.0, 0.1])
    solved, q, start = 0, robot.home, controller.tool_pose("left").translation[0]
    for _ in range(150):
        problem = controller.problem(goals, 0.002)
        assert problem.P.shape == (len(problem.q),) * 2
        x = qpsolvers.solve_problem(problem, solver=ANY).x
        reference = controller.advance(x, goals, 0.002)
        solved += x is not None and not reference.report.fallback
        assert reference.report.certified
        A, _ = forwards.rows(q, reference.v)
        assert A @ reference.v >= -1e-4 * np.linalg.norm(A)
        q = reference.q
    assert solved > 140
    assert not controller.step(goals, 0.002).report.unsolved, "the named solver goes on where the program ends"
    assert controller.tool_pose("left").translation[0] > start - 1e-3, "where it was sent 100 mm back"
    assert controller.tool_pose("right").translation[0] < goals["right"].translation[0] + 0.08
    assert controller.tool_pose("left").translation[2] > goals["left"].translation[2] - 0.08


@pytest.mark.slow
def test_a_user_program_with_its_own_solver_keeps_every_distance(cell: Config) -> None:
    robot, solver = Robot.from_config(cell), OwnSolver()
    typed: Solver = solver
    controller = CartesianController(robot, cell.control.timed(realtime=False), solver=typed)
    left, right = controller.tool_pose("left"), controller.tool_pose("right")
    left.translation, right.translation = right.translation.copy(), left.translation.copy()
    for _ in range(300):
        reference = controller.step({"left": left, "right": right}, 0.002)
        assert reference.report.certified
        assert reference.report.margin > -1e-9
    assert reference.report.closest_distance < 0.2
