"""Short motions with every solver: each limit and each distance is kept at every tick."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.types import Array, Reference
from q2r2_control.verification.promises import COAL
from tests.control.scenarios import Targets, circle
from tests.control.test_scenarios import CASES, Case, ticks_of
from tests.qp.solvers import NAMES, ROBOT, controller_with, each_solver
from tests.support.driven import Driven

DT, MOVING, RESTING = 0.002, 0.16, 2.5  # Durations of a tick, of the motion, and of the wait for rest [s].
SLOWLY_OUT = "start in penetration"  # In this motion arms move apart at 50 mm/s, and a tick has up to 80 rows.
REST, RESTED = 1e-3, 0.02  # Arms rest if all joints are slower than this [rad/s] for this time [s].
TRACKING = 1.05  # Largest tracking error with another solver, as a multiple of the error with DAQP.
ROUNDING = 1e-9
MOTIONS = {name: case for name, case in CASES.items() if case.fault is None}
SHORTEST = ("crossing", "circle", SLOWLY_OUT)  # With DAQP and OSQP, these motions are not marked as slow.


@dataclass(frozen=True, slots=True)
class Motion:
    """One run, in which the tools first follow their targets and the arms then hold."""

    references: list[Reference]  # The references while the arms have targets.
    error: float  # RMS error of the tool that is farther from its target [m].
    unsolved: int  # Number of ticks without a solution.
    rested: bool | None  # None if the test does not wait for rest.


def _error(controller: CartesianController, targets: Targets) -> float:
    ways = [pose.translation - controller.tool_pose(arm).translation for arm, pose in targets.items() if pose]
    return max(float(np.linalg.norm(way)) for way in ways)


@cache
def motion(solver: str, name: str) -> Motion:
    """Drive a motion of ``MOTIONS`` with the contract checked at every tick."""
    case, controller = MOTIONS[name], controller_with(solver)
    driven = Driven(controller, *case.start(ROBOT), dt=DT, random=np.random.default_rng(3))
    references, errors, t = [], [], 0.0
    for length in ticks_of(DT, case.jitter):
        if t >= MOVING:
            break
        targets = case.scenario(t, driven.start)
        driven.dt = length
        references.append(driven.drive(length, targets))
        errors.append(_error(controller, targets))
        t += length
    return Motion(
        references,
        float(np.sqrt(np.nanmean(np.square(errors)))) if np.isfinite(errors).any() else 0.0,
        sum(reference.report.unsolved > 0 for reference in references),
        _comes_to_rest(driven) if name != SLOWLY_OUT or solver == "daqp" else None,
    )


def _comes_to_rest(driven: Driven) -> bool:
    """Let the arms hold, and return whether they come to rest within ``RESTING``. The contract is checked too."""
    driven.dt, slow = DT, 0.0
    for _ in range(round(RESTING / DT)):
        slow = slow + DT if np.abs(driven.drive(DT, {}).v).max() < REST else 0.0
        if slow >= RESTED:
            return True
    return False


def _every(solver: str, name: str) -> pytest.ParameterSet:
    short = name in SHORTEST and solver in NAMES[:2]
    return pytest.param(solver, name, marks=() if short else pytest.mark.slow, id=f"{name} with {solver}")


@pytest.mark.parametrize(("solver", "name"), [_every(solver, name) for solver in NAMES for name in MOTIONS])
def test_with_every_solver_arms_keep_the_contract_and_come_to_rest_and_follow_as_well_as_with_daqp(
    solver: str, name: str
) -> None:
    run = motion(solver, name)
    assert run.rested is not False
    assert run.unsolved <= 0.01 * len(run.references)
    assert run.error <= TRACKING * motion("daqp", name).error


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a run, computed from the robot and the settings and not from the controller's own data."""

    lower: Array  # (nv,) [rad]
    upper: Array  # (nv,) [rad]
    velocity: Array  # (nv,) [rad/s]
    acceleration: Array  # (nv,) [rad/s^2]
    distances: Array  # (p,) Distance that each pair keeps [m].


def limits_of(controller: CartesianController) -> Limits:
    settings = controller.settings
    return Limits(
        ROBOT.position_lower + settings.position_margin,
        ROBOT.position_upper - settings.position_margin,
        ROBOT.velocity_limit * settings.velocity_scale,
        ROBOT.capped_acceleration(settings.acceleration_limit),
        kept_distances(ROBOT, settings).values,
    )


def from_rest(case: Case) -> bool:
    return not case.recovers and not case.jitter


def assert_within(limits: Limits, references: list[Reference]) -> None:
    """Check that ``references``, which are ``DT`` [s] apart and begin at rest, keep the limits and the distances.

    Within a tick the motion is a parabola, so positions and velocities have to agree.
    """
    q = np.array([reference.q for reference in references])
    v = np.array([reference.v for reference in references])
    assert (q >= limits.lower - ROUNDING).all()
    assert (q <= limits.upper + ROUNDING).all()
    assert (np.abs(v) <= limits.velocity * (1.0 + ROUNDING)).all()
    changes = np.abs(np.diff(v, axis=0, prepend=0.0)) / DT
    assert (changes <= limits.acceleration * (1.0 + ROUNDING)).all()
    np.testing.assert_allclose(np.diff(q, axis=0), 0.5 * DT * (v[1:] + v[:-1]), atol=1e-11)
    for posture in q:
        assert (ROBOT.distance_values(posture) >= limits.distances - COAL).all()


@pytest.mark.parametrize(
    ("solver", "name"), [_every(solver, name) for solver in NAMES for name in MOTIONS if from_rest(MOTIONS[name])]
)
def test_limits_and_distances_hold_at_every_tick_as_checked_with_simple_arithmetic_and_coal(
    solver: str, name: str
) -> None:
    assert_within(limits_of(controller_with(solver)), motion(solver, name).references)


@pytest.mark.parametrize("solver", each_solver())
def test_joints_that_are_driven_towards_their_limits_reach_each_limit_and_exceed_no_limit(solver: str) -> None:
    controller, last = controller_with(solver), [arm.joints[-1] for arm in ROBOT.arms.values()]
    limits, q = limits_of(controller), ROBOT.home.copy()
    q[last] = limits.upper[last] - 1.2
    driven = Driven(controller, q, dt=DT)
    q[last] = limits.upper[last] + 1.0
    controller.hold_at(q)
    references = [driven.drive(DT, {}) for _ in range(450)]
    controller.hold_at(None)
    assert_within(limits, references)
    fastest = np.max([np.abs(reference.v) for reference in references], axis=0)
    strongest = np.max([np.abs(reference.a) for reference in references], axis=0)
    np.testing.assert_allclose(fastest[last], limits.velocity[last], rtol=1e-3)
    np.testing.assert_allclose(strongest[last], limits.acceleration[last], rtol=1e-3)
    np.testing.assert_allclose(references[-1].q[last], limits.upper[last], atol=2e-3)


def test_a_target_that_moves_on_a_reachable_circle_is_followed_within_5_mm() -> None:
    assert MOTIONS["circle"].scenario is circle
    assert 1e-3 < motion("daqp", "circle").error < 5e-3


def test_crossing_targets_bring_pairs_within_millimetres_of_their_kept_distances() -> None:
    """Motions of this file bring pairs to their kept distances. A solver therefore has to use the separation rows."""
    controller = controller_with("daqp")
    controller.reset(ROBOT.home)
    left, right = controller.tool_pose("left"), controller.tool_pose("right")
    targets = {"left": pin.SE3(left.rotation, right.translation), "right": pin.SE3(right.rotation, left.translation)}
    margins = [controller.step(targets, DT).report.margin for _ in range(600)]
    assert 0.0 <= min(margins) < 5e-3
