"""The soak finds no fault in the real controller, and finds each kind of broken promise at its tick."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import qpsolvers

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.qp import QpProblem, QpSolution
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Reference
from q2r2_control.verification.fault_injection import FINGERS, FaultySolver, WorstSolver, untimed, with_contact
from q2r2_control.verification.soak import Soak, SoakReport, run_soak, steady_growth
from tests.support.object_cell import cell

pytestmark = pytest.mark.slow

CONFIG = load_config("config/dual_iiwa7.yaml")
SETTINGS = CONFIG.control
SEED = 5


@cache
def robot() -> Robot:
    return Robot.from_config(CONFIG)


@cache
def controller_and_solver() -> tuple[CartesianController, FaultySolver]:
    solver = FaultySolver(DaqpSolver(robot().model.nv), np.random.default_rng(0))
    return CartesianController(robot(), SETTINGS, solver=untimed(solver, robot().model.nv)), solver


class Sabotaged:
    """The real controller, but its results are changed from one tick on."""

    def __init__(self, change: Callable[[Reference], Reference], first: int, settings: ControllerSettings) -> None:
        self.settings, self.kept_distances = settings, kept_distances(robot(), settings).values
        self._change, self._first = change, first
        self._ticks = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(controller_and_solver()[0], name)

    def change(self, values: Any) -> str | None:
        return "a distance that has changed would hide what is sabotaged"

    def step(self, targets: Any, dt: Any) -> Reference:
        reference = controller_and_solver()[0].step(targets, dt)
        self._ticks += 1
        return self._change(reference) if self._ticks > self._first else reference


def soak(
    change: Callable[[Reference], Reference],
    first: int,
    ticks: int,
    settings: ControllerSettings = SETTINGS,
    solver: FaultySolver | None = None,
) -> SoakReport:
    controller: Any = Sabotaged(change, first, settings)
    return Soak("cell", controller, solver or controller_and_solver()[1], SEED).run(ticks)


WITH_OBJECTS = cell({"box": (0.1, 0.2, 0.06), "at": (0.0, 0.0, 0.02)}, {})
HOSTILE = {"resets": 1, "solver_faults": 0, "attacks": 100, "openings": 100, "distance - kept distance, at ticks": 500}
GRASPING = {"grasps": 40, "held objects: kept distance falls by": 1000}


@pytest.mark.parametrize(
    ("config", "seed", "least"),
    [
        pytest.param(CONFIG, 2, HOSTILE, id="free"),
        pytest.param(with_contact(CONFIG, FINGERS), 3, {}, id="where fingers may touch"),
        pytest.param(WITH_OBJECTS, 1, GRASPING, id="objects gripped and let go at any moment"),
    ],
)
def test_hostile_input_never_breaks_the_contract(config: Config, seed: int, least: dict[str, int]) -> None:
    report = run_soak(config, 3000, seed)
    assert [found.promise for found in report.broken] == []
    assert report.passed
    counts = report.counts | {margin.name: margin.checked for margin in report.margins}
    assert all(counts[name] > count for name, count in least.items())


@pytest.mark.parametrize("name", ["osqp", "quadprog"])
def test_hostile_input_with_another_solver_never_breaks_the_contract(name: str) -> None:
    if name not in ("osqp", *qpsolvers.available_solvers):
        pytest.skip(f"{name} is not installed")
    config = CONFIG.model_copy(update={"control": SETTINGS.with_solver(name)})
    report = run_soak(config, 1500, 4)
    assert report.passed, report.broken
    assert report.solver == name
    assert report.counts["unsolved"] < 0.01 * report.ticks


def test_hostile_input_moves_no_tool_faster_than_its_limit() -> None:
    limited = CONFIG.model_copy(update={"control": SETTINGS.model_copy(update={"tool_speed_limit": 0.25})})
    report = run_soak(limited, 2000, 9)
    assert report.passed, report.broken
    (margin,) = [margin for margin in report.margins if margin.name.startswith("tool speed")]
    assert margin.checked > 1000
    assert margin.worst > 0.8, "the limit was never met"


@pytest.mark.parametrize("jerk", [1000.0, 5000.0])
def test_commands_under_hostile_input_keep_the_jerk_limit_and_all_distances(jerk: float) -> None:
    limited = CONFIG.model_copy(update={"control": SETTINGS.model_copy(update={"jerk_limit": jerk})})
    report = run_soak(limited, 3000, 3)
    assert report.passed, report.broken
    of = {margin.name.split(",")[-1].strip(): margin for margin in report.margins}
    assert of["jerk of averaged commands / limit"].worst > 0.9, "the limit was never met"
    assert of["averaged commands"].checked > 5


class Garbage:
    """A solver with random invalid answers: no answer, wrong types, or numbers that only resemble an answer."""

    def __init__(self) -> None:
        self.random, self.asked = np.random.default_rng(1), 0

    def solve(self, problem: QpProblem) -> Any:
        self.asked += 1
        nv = len(problem.g)
        return (
            lambda: QpSolution(self.random.normal(size=nv) * 10.0 ** self.random.uniform(-3.0, 12.0), 0.0),
            lambda: QpSolution(np.where(self.random.random(nv) < 0.5, problem.lower, problem.upper), 0.0),
            lambda: QpSolution(np.full(nv, np.nan), 0.0),
            lambda: QpSolution(np.zeros((nv, nv)), 0.0),
            lambda: QpSolution(np.zeros(nv), float("nan")),
            lambda: QpSolution(None, 0.0),
            lambda: None,
            lambda: 1 / 0,
            lambda: self._writing(problem),
            lambda: self._late(problem),
        )[int(self.random.integers(10))]()

    def _writing(self, problem: QpProblem) -> QpSolution:
        for array in (problem.H, problem.g, problem.lower, problem.upper, problem.rows, problem.rows_lower):
            array[...] = 1e9
        return QpSolution(problem.upper, 0.0)

    def _late(self, problem: QpProblem) -> QpSolution:
        time.sleep(0.002)
        return QpSolution(problem.upper, 0.002)


def test_hostile_input_with_a_solver_that_returns_garbage_never_breaks_the_contract() -> None:
    solver = Garbage()
    report = run_soak(CONFIG, 2000, 8, solver=solver)
    assert report.passed, report.broken
    assert report.solver == "Garbage"
    assert solver.asked > 500
    assert report.counts["unsolved"] > 200


class Impossible:
    """A constraint that demands joint speeds that no acceleration limit allows."""

    hard = True

    def rows(self, q: Array, v: Array) -> Any:
        return np.eye(len(q)), np.full(len(q), 50.0)


class Flipping:
    """A constraint that reverses its rows at each tick: three joints have to turn forwards, and then backwards."""

    hard = True

    def __init__(self) -> None:
        self.sign, self.random = 1.0, np.random.default_rng(2)

    def rows(self, q: Array, v: Array) -> Any:
        self.sign = -self.sign
        return self.sign * np.eye(len(q))[:3], np.full(3, float(self.random.uniform(-0.2, 0.05)))


class Moody:
    """A constraint with mostly harmless rows, and at random invalid ones: NaN, another shape, an exception."""

    hard = True

    def __init__(self) -> None:
        self.random, self.asked = np.random.default_rng(3), 0

    def rows(self, q: Array, v: Array) -> Any:
        self.asked += 1
        usual = (-np.sign(v + 1e-300)[None, :], np.array([-3.0]))  # The sum of the joints' speeds is at most 3 rad/s.
        if self.asked < 50 or self.random.random() < 0.7:
            return usual
        kind = int(self.random.integers(5))
        if kind == 0:
            raise RuntimeError("moody")
        return (
            None,
            (np.full((1, len(q)), np.nan), np.zeros(1)),
            (np.ones((2, 3)), np.ones(7)),
            (np.full((1, len(q)), 1e-12), np.ones(1)),
            (q, v),
        )[kind]


@pytest.mark.parametrize("constraint", [Impossible(), Flipping(), Moody()], ids=lambda one: type(one).__name__)
def test_hostile_input_with_a_hostile_hard_constraint_never_breaks_the_contract(constraint: Any) -> None:
    solver = FaultySolver(
        DaqpSolver(robot().model.nv), np.random.default_rng(1), WorstSolver(robot(), np.random.default_rng(2))
    )
    controller = CartesianController(
        robot(), SETTINGS, solver=untimed(solver, robot().model.nv), constraints=[constraint]
    )
    report = Soak("cell", controller, solver, 6).run(2000)
    assert report.passed, report.broken
    assert report.counts["fallbacks_healthy"] > 20


def test_fingers_that_open_without_a_proof_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    real = CartesianController._observe_again

    def accepted(self: CartesianController, grown: Any) -> int:
        real(self, grown)
        return -1

    monkeypatch.setattr(CartesianController, "_observe_again", accepted)
    report = run_soak(CONFIG, 2000, 3)
    assert report.counts["openings"] > 100
    assert report.counts["openings_refused"] == 0
    assert "distance - kept distance, at ticks" in {found.promise for found in report.broken}


def test_two_soaks_with_equal_seeds_are_equal() -> None:
    first, second, other = (run_soak(CONFIG, 150, seed) for seed in (5, 5, 6))
    assert first.margins == second.margins
    assert first.margins != other.margins


def _faster(reference: Reference) -> Reference:
    v = reference.v.copy()
    v[3] += 0.5
    return replace(reference, v=v)


def _raise(reference: Reference) -> Reference:
    raise ZeroDivisionError("sabotage")


def _report(**changes: Any) -> Callable[[Reference], Reference]:
    return lambda reference: replace(reference, report=replace(reference.report, **changes))


@pytest.mark.parametrize(
    ("change", "promise"),
    [
        (_faster, "acceleration / limit"),
        (lambda reference: replace(reference, v=np.full(14, 10.0)), "velocity / limit"),
        (lambda reference: replace(reference, q=robot().position_upper - 0.005), "room to position limits"),
        (lambda reference: replace(reference, q=reference.q + 0.01), "off constant acceleration or the stop"),
        (lambda reference: replace(reference, q=np.full(14, np.nan)), "references that are not finite"),
        (_raise, "exceptions raised by step"),
        (_report(certified=False), "certificates lost"),
        (_report(closest_distance=0.019), "distance - kept distance, at ticks"),
        (_report(rejected=("left",)), "usable targets rejected"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_broken_promise_is_found_in_the_tick_in_which_it_is_broken(
    change: Callable[[Reference], Reference], promise: str
) -> None:
    report = soak(change, first=12, ticks=100)
    assert not report.passed
    found = {violation.promise: violation for violation in report.broken}
    assert found[promise].tick == 12
    assert min(violation.tick for violation in report.broken) == 12
    assert found[promise].q.shape == found[promise].v.shape == (14,)
    assert found[promise].segment
    assert next(margin for margin in report.margins if margin.name == promise).tick is not None


def test_a_wrong_reported_distance_is_found_by_coal() -> None:
    report = soak(_report(closest_distance=1.0), first=0, ticks=200)
    assert [found.promise for found in report.broken] == ["reported distance off Coal's"]


def test_arms_that_come_too_close_are_found_at_ticks_and_between_ticks_and_during_stops() -> None:
    """The controller keeps 20 mm, but the contract is checked with 150 mm."""
    report = soak(lambda reference: reference, 0, 1000, settings=SETTINGS.model_copy(update={"min_distance": 0.15}))
    promises = {found.promise for found in report.broken}
    assert {f"distance - kept distance, {when}" for when in ("at ticks", "between ticks", "full stops")} <= promises


def test_a_stop_that_is_due_and_not_executed_is_found() -> None:
    """The soak makes a solver fail that the controller does not use, so the controller executes no stop."""
    elsewhere = FaultySolver(DaqpSolver(14), np.random.default_rng(0))
    controller_and_solver()[1].fault = None
    report = soak(lambda reference: reference, 0, 300, solver=elsewhere)
    assert {found.promise for found in report.broken} == {
        "solver failed: off the stop",
        "solver failed: stop not reported",
    }


def test_while_bodies_leave_a_penetration_their_distance_never_decreases() -> None:
    """A soak found this case. The wrist is 16 mm inside the table, and its distance grows to 0.5 mm.

    The stop then reduced the distance by 0.3 mm.
    """
    left = [-0.21607004362824325, 1.5400883486752313, 1.949636558861823, 0.6047422668811306]
    left += [0.8080053095448911, 1.4352829330812347, 1.9429994776891732]
    right = [-2.159257201510056, -1.1332045586738233, -0.5307167749313296, -1.634581274414817]
    right += [0.41549249198273613, -0.42718684115100136, -0.9995136992527016]
    q = np.array(left + right)
    controller, solver = controller_and_solver()
    solver.fault = None
    home = {arm: robot().tool_pose(robot().home, arm) for arm in robot().arms}
    crossing = {"left": home["right"], "right": home["left"]}
    controller.reset(q)
    least = min(pair.distance for pair in robot().distances(q))
    for tick in range(600):
        distance = controller.step(crossing, 0.001).report.closest_distance
        if tick:
            assert distance >= min(least, SETTINGS.min_distance) - 1e-9, tick
        least = distance


@pytest.mark.parametrize(
    ("memory", "growth"),
    [((100.0, 103.0, 106.0, 109.0), 9.0), ((142.0, 145.0, 147.5, 147.1), -1.2), ((100.0, None, 100.0, 100.0), None)],
    ids=["a leak", "a heap that settles", "unknown"],
)
def test_a_steady_growth_of_memory_is_reported_and_a_heap_that_settles_is_not_reported(
    memory: tuple[float | None, ...], growth: float | None
) -> None:
    found = steady_growth(memory)
    assert found == (None if growth is None else pytest.approx(growth))
