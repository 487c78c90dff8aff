"""Named hostile motions for each robot. The contract is checked at every tick.

To add a robot, add a line to ``ROBOTS`` and a line to the parameters of the test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, StepStatus
from q2r2_control.verification.contract import Contract
from q2r2_control.verification.fault_injection import ATTACKS, STOPPING_FAULTS, FaultySolver, WorstSolver, untimed
from tests.control.cells import pandas
from tests.control.scenarios import SCENARIOS, Scenario, circle, crossing

# Durations [s] of a run and of a run with long ticks, and the duration of a long tick [s]. Runs with long ticks last
# longer, so that they have enough ticks: the test bounds the fraction of ticks with a fallback.
DURATION, DURATION_OF_LONG_TICKS, LONG_TICK = 1.2, 2.0, 0.01
# A faulty solver fails in the last part of every period [s]. FAULT_SHARE is this part's fraction of the period.
FAULT_PERIOD, FAULT_SHARE = 0.2, 0.2
AGAINST_US = "against us"  # All attacks in turn, each for one period.
Start = Callable[[Robot], tuple[Array, Array]]


ROBOTS: dict[str, Callable[[], Config]] = {
    "iiwa7": lambda: load_config("config/dual_iiwa7.yaml"),
    "panda": pandas,
}


@cache
def robot_of(name: str) -> Robot:
    return Robot.from_config(ROBOTS[name]())


@cache
def controller_of(name: str) -> tuple[CartesianController, FaultySolver]:
    """Return the controller of a robot, and its solver.

    The controller is made once, and a reset starts it again. The solver's times are simulated.
    """
    settings = ControllerSettings(solve_time_limit=0.05)
    solver = FaultySolver(DaqpSolver(robot_of(name).model.nv))
    return CartesianController(robot_of(name), settings, solver=untimed(solver, robot_of(name).model.nv)), solver


def at_home(robot: Robot) -> tuple[Array, Array]:
    return robot.home.copy(), np.zeros(robot.model.nv)


def outside_its_limits(robot: Robot) -> tuple[Array, Array]:
    """Return a posture with the last joint of every arm 0.05 rad beyond its upper limit."""
    q, v = at_home(robot)
    for arm in robot.arms.values():
        q[arm.joints[-1]] = robot.position_upper[arm.joints[-1]] + 0.05
    return q, v


def in_penetration(robot: Robot) -> tuple[Array, Array]:
    """Return a posture in which the arms overlap by 39 mm, because they are turned inwards and leant forwards."""
    first = [arm.joints[0] for arm in robot.arms.values()]

    def turned(turn: float) -> Array:
        q = robot.home.copy()
        q[first] += np.array([-turn, turn])
        q[np.add(first, 1)] += 0.25 * turn
        return q

    def deep(turn: float) -> bool:
        return min(pair.distance for pair in robot.distances(turned(turn))) <= -0.039

    high = next(turn for turn in np.arange(0.0, 1.5, 0.01) if deep(turn))
    low = high - 0.01
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if deep(middle) else (middle, high)
    return turned(high), np.zeros(robot.model.nv)


def too_fast(robot: Robot) -> tuple[Array, Array]:
    """Return home, and velocities at which the first and last joint of each arm exceed their limits by a fifth.

    The arms turn in opposite directions.
    """
    q, v = at_home(robot)
    for arm, sign in zip(robot.arms.values(), (1.0, -1.0), strict=True):
        v[arm.joints[0]] = 1.2 * sign * robot.velocity_limit[arm.joints[0]]
        v[arm.joints[-1]] = 1.2 * sign * robot.velocity_limit[arm.joints[-1]]
    return q, v


@dataclass(frozen=True, slots=True)
class Case:
    """A case: targets over time, the start of the robot, whether ticks jitter, and how the solver fails."""

    scenario: Scenario
    start: Start = at_home
    jitter: bool = False
    fault: str | None = None

    def fault_at(self, t: float) -> str | None:
        if self.fault == AGAINST_US:
            return ATTACKS[int(t / FAULT_PERIOD) % len(ATTACKS)]
        return self.fault if t % FAULT_PERIOD >= (1.0 - FAULT_SHARE) * FAULT_PERIOD else None

    @property
    def recovers(self) -> bool:
        return self.start in (outside_its_limits, in_penetration, too_fast)


CASES = {
    **{name: Case(scenario) for name, scenario in SCENARIOS.items()},
    "start outside": Case(circle, start=outside_its_limits),
    "start in penetration": Case(crossing, start=in_penetration),
    "velocity start": Case(crossing, start=too_fast),
    "jittering dt": Case(crossing, jitter=True),
    "solver failure": Case(crossing, fault="none"),
    "solver not finite": Case(crossing, fault="nan"),
    "solver late": Case(crossing, fault="late"),
    "solver absurd": Case(crossing, fault="absurd"),
    "solver against us": Case(crossing, fault=AGAINST_US),
}


def ticks_of(dt: float, jitter: bool) -> Iterator[float]:
    """Yield the durations of the ticks of one run [s].

    With jitter, a duration is between a fifth of ``dt`` and five times ``dt``.
    """
    random, t = np.random.default_rng(5), 0.0
    duration = DURATION_OF_LONG_TICKS if dt >= LONG_TICK else DURATION
    while t < duration:
        length = dt * 5.0 ** random.uniform(-1.0, 1.0) if jitter else dt
        t += length
        yield length


# With the first dt, a tick is shorter than a substep. With the second dt, it has five substeps.
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(
    ("robot", "dt"), [("iiwa7", 0.001), ("iiwa7", 0.01), pytest.param("panda", 0.01, marks=pytest.mark.slow)]
)
def test_the_contract_holds_at_every_tick_of_every_hostile_motion(name: str, robot: str, dt: float) -> None:
    case = CASES[name]
    controller, solver = controller_of(robot)
    q, v = case.start(controller.robot)
    controller.reset(q, v)
    solver.q, solver.kept = q, controller.kept_distances
    solver.worst = WorstSolver(controller.robot, np.random.default_rng(6))
    contract = Contract(controller, q, v)
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    t, statuses, failed, unfounded = 0.0, set(), 0, 0
    for length in ticks_of(dt, case.jitter):
        solver.fault = case.fault_at(t)
        reference = controller.step(case.scenario(t, start), length)
        contract.check(reference, length, failed=solver.fault in STOPPING_FAULTS)
        failed += solver.fault in STOPPING_FAULTS
        solver.q = reference.q
        unfounded += reference.report.fallback and solver.fault is None
        statuses.add(reference.report.status)
        t += length
    # Only a start in penetration has no certificate at first.
    assert (contract.uncertified > 0) == (case.start is in_penetration)
    assert failed == 0 or case.fault in STOPPING_FAULTS
    # An absurd solution is followed as far as it is certified. In the ticks after it, the rows of the QP may act too
    # late to prevent a fallback, although the solver works again.
    assert unfounded <= (0.02 if case.fault == "absurd" else 0.001) * contract.ticks
    if case.recovers:
        assert StepStatus.RECOVERING in statuses
        assert reference.report.status is not StepStatus.RECOVERING
