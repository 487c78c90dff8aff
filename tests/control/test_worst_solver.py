"""Nothing but the certificate stands between: a solver that works against the arms and sees no separation row."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.config.cell import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.qp import QpProblem, QpSolution
from q2r2_control.control.safety.safety_data import ROUNDING
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, StepStatus
from q2r2_control.verification.contract import Contract
from q2r2_control.verification.fault_injection import WorstSolver

CONFIG = load_config("config/dual_iiwa7.yaml")
DTS = (0.001, 0.004, 0.0005, 0.01, 0.03)


class Attack:
    """A solver whose answers are those of one attack."""

    def __init__(self, robot: Robot, seed: int) -> None:
        self._worst = WorstSolver(robot, np.random.default_rng(seed))
        self.q, self.kept = robot.home, np.zeros(len(robot.collision_model.collisionPairs))
        self.attack = "towards_nearest"

    def solve(self, problem: QpProblem) -> QpSolution:
        return QpSolution(self._worst.answer(self.attack, problem, self.q, self.kept), 0.0)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(CONFIG)


def least_margin(
    robot: Robot, settings: ControllerSettings, start: Array, ticks: int, attack: str, seed: int
) -> tuple[float, int]:
    """Least margin of a pair at any tick by Coal [m], and how many ticks had no certificate."""
    solver = Attack(robot, seed)
    controller = CartesianController(robot, settings, solver=solver)
    solver.attack, solver.kept, solver.q = attack, controller.kept_distances, start
    controller.reset(start)
    contract = Contract(controller, start, random=np.random.default_rng(seed))
    least, uncertified = np.inf, 0
    for tick in range(ticks):
        dt = DTS[(tick // 150) % len(DTS)]
        reference = controller.step({}, dt)
        contract.check(reference, dt)
        solver.q = reference.q
        least = min(least, float((robot.distance_values(reference.q) - controller.kept_distances).min()))
        uncertified += not reference.report.certified
    return least, uncertified


@pytest.mark.parametrize("attack", ["towards_nearest", "corner"])
def test_the_worst_solver_brings_no_pair_closer_than_it_keeps(robot: Robot, attack: str) -> None:
    least, uncertified = least_margin(robot, CONFIG.control, robot.home, 1500, attack, seed=1)
    assert -ROUNDING <= least < 1e-4, "it has to get there, and no further"
    assert uncertified == 0


def test_a_pair_that_is_closer_by_rounding_keeps_its_certificate_and_its_distance(robot: Robot) -> None:
    nearest = float(robot.distance_values(robot.home).min())
    settings = ControllerSettings(min_distance=nearest + 1e-15)
    assert nearest < settings.min_distance
    controller = CartesianController(robot, settings)
    controller.reset(robot.home)
    reports = [controller.step({}, 0.001).report for _ in range(100)]
    assert all(report.certified for report in reports)
    assert StepStatus.RECOVERING not in {report.status for report in reports}
    assert reports[-1].margin > 1e-4, "the pair opens to its buffer"
    least, uncertified = least_margin(robot, settings, robot.home, 600, "towards_nearest", seed=2)
    assert -ROUNDING <= least < 0.0
    assert uncertified == 0
