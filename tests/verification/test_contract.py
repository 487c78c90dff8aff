"""The contract checker finds small breaches of a promise, and names the promise and the excess."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.control import ControllerSettings
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Reference, StepReport, StepStatus
from q2r2_control.verification.contract import Contract
from q2r2_control.verification.promises import Margin
from tests.control.test_scenarios import in_penetration

SETTINGS = ControllerSettings()
DT = 0.001
JOINT = 2
FASTEST = 5.69 * DT  # Largest change of velocity of A3 of an iiwa 7 in a tick [rad/s]. Other joints may change faster.


@pytest.fixture(scope="module")
def apart(robot: Robot) -> StepReport:
    """Return a report in which only the distances at home are set."""
    nearest = min(robot.distances(robot.home), key=lambda pair: pair.distance)
    pair, margin = (nearest.name_a, nearest.name_b), nearest.distance - SETTINGS.min_distance
    return StepReport(StepStatus.OK, (), (), pair, nearest.distance, True, False, 0.0, 0.0, pair, margin)


def contract_of(robot: Robot, q: Array | None = None, v: Array | None = None, **options: Any) -> Contract:
    """Return the contract of a controller whose certified stop uses every joint's acceleration limit."""
    limit = robot.capped_acceleration(SETTINGS.acceleration_limit)
    kept = kept_distances(robot, SETTINGS).values
    controller: Any = SimpleNamespace(
        robot=robot, settings=SETTINGS, stop_deceleration=limit, object_distances=np.zeros(0), kept_distances=kept
    )
    return Contract(controller, q, v, **options)


def one(value: float) -> Array:
    """Return an array with this value for one joint, and 0 for the others."""
    values = np.zeros(14)
    values[JOINT] = value
    return values


def moved(q: Array, v: Array, change: float, report: StepReport) -> Reference:
    """Return the reference one tick after ``q`` and ``v``. The velocity of one joint changes by ``change`` [rad/s]."""
    after = v + one(change)
    return Reference(q + 0.5 * DT * (v + after), after, one(change / DT), report)


def test_a_broken_promise_raises_an_error_with_its_name_its_value_and_what_is_allowed(
    robot: Robot, apart: StepReport
) -> None:
    contract = contract_of(robot)
    contract.check(moved(robot.home, np.zeros(14), FASTEST, apart), DT, frozenset())
    assert contract.margins["acceleration"].worst == pytest.approx(1.0)
    contract = contract_of(robot)
    contract.check(moved(robot.home, np.zeros(14), 0.0, apart), DT)
    with pytest.raises(AssertionError, match=r"^tick 1: acceleration / limit: 1\.0001, allowed <= 1\.000000001$"):
        contract.check(moved(robot.home, np.zeros(14), 1.0001 * FASTEST, apart), DT)


@pytest.mark.parametrize(
    ("promise", "changes", "report"),
    [
        ("jump", {"q": one(1e-4)}, {}),
        ("parabola", {"q": one(1e-9)}, {}),
        ("acceleration", {"a": one(1.001 * FASTEST / DT)}, {}),
        ("velocity", {"v": one(10.0)}, {}),
        ("position", {"q": one(4.0)}, {}),
        ("not_finite", {"a": one(np.nan)}, {}),
        ("distance", {}, {"margin": -2e-9}),
        ("uncertified", {}, {"certified": False}),
        ("unreported", {}, {"rejected": ()}),
        ("refused", {}, {"rejected": ("left", "right")}),
    ],
)
def test_a_breach_of_each_promise_is_found(
    robot: Robot, apart: StepReport, promise: str, changes: dict[str, Any], report: dict[str, Any]
) -> None:
    still = Reference(robot.home, np.zeros(14), np.zeros(14), replace(apart, rejected=("left",)))
    contract = contract_of(robot)
    assert not contract.observe(still, DT, frozenset({"left"}))
    added = {name: getattr(still, name) + value for name, value in changes.items()}
    broken = contract.observe(replace(still, **added, report=replace(still.report, **report)), DT, frozenset({"left"}))
    assert promise in broken


def test_if_a_solver_fails_and_the_certified_stop_is_not_executed_two_promises_are_broken(
    robot: Robot, apart: StepReport
) -> None:
    contract = contract_of(robot)
    broken = contract.observe(moved(robot.home, np.zeros(14), FASTEST, apart), DT, failed=True)
    assert list(broken) == ["not_stopped", "unsaid"]


def test_a_joint_that_started_too_fast_must_not_become_faster_or_exceed_its_limit_again(
    robot: Robot, apart: StepReport
) -> None:
    limit = float(robot.velocity_limit[JOINT])
    q, v = robot.home, one(limit + 0.5 * FASTEST)
    contract = contract_of(robot, q, v)
    faster = moved(q, v, 1e-10, apart)
    assert list(contract_of(robot, q, v).observe(faster, DT)) == ["too_fast"]
    slower = moved(q, v, -FASTEST, apart)
    assert not contract.observe(slower, DT)
    assert list(contract.observe(moved(slower.q, slower.v, FASTEST, apart), DT)) == ["velocity"]


def test_a_joint_that_started_outside_its_limits_must_not_move_farther_out(robot: Robot, apart: StepReport) -> None:
    q = robot.home.copy()
    q[JOINT] = robot.position_upper[JOINT] + 0.05
    assert list(contract_of(robot, q).observe(moved(q, np.zeros(14), 1e-6, apart), DT)) == ["outward"]
    assert not contract_of(robot, q).observe(moved(q, np.zeros(14), -1e-6, apart), DT)


def test_a_joint_that_has_returned_into_its_limits_must_stay_there(robot: Robot, apart: StepReport) -> None:
    limit = robot.position_upper[JOINT] - SETTINGS.position_margin
    q = robot.home.copy()
    q[JOINT] = limit + 1e-5
    contract = contract_of(robot, q)
    inside = Reference(q - one(2e-5), np.zeros(14), np.zeros(14), apart)
    contract.observe(inside, DT)
    assert "position" in contract.observe(moved(inside.q + one(2e-5), np.zeros(14), 0.0, apart), DT)


def test_a_tick_of_zero_duration_must_not_move_anything(robot: Robot, apart: StepReport) -> None:
    moves = Reference(robot.home + one(1e-12), one(0.0), one(0.0), apart)
    assert list(contract_of(robot).observe(moves, 0.0)) == ["idle"]


def test_the_contract_finds_a_joint_that_cannot_stop_before_its_limit(robot: Robot, apart: StepReport) -> None:
    q = robot.home.copy()
    q[JOINT] = robot.position_upper[JOINT] - SETTINGS.position_margin - 0.7 * FASTEST * DT
    contract = contract_of(robot, q, sample_all=True)
    assert "stop_position" in contract.observe(moved(q, np.zeros(14), FASTEST, apart), DT)


def test_recovering_pairs_must_not_come_closer_and_must_keep_their_distance_as_soon_as_they_have_it(
    robot: Robot, apart: StepReport
) -> None:
    q, v = in_penetration(robot)
    contract = contract_of(robot, q)

    def observed(distance: float, certified: bool = False) -> list[str]:
        margin = distance - SETTINGS.min_distance
        report = replace(apart, closest_distance=distance, margin=margin, certified=certified)
        return list(contract.observe(moved(q, v, 0.0, report), DT))

    assert observed(-0.03) == observed(-0.02) == []
    assert observed(-0.0201) == ["approach"]
    assert observed(0.021) == []
    assert observed(0.0199) == ["distance"]
    assert observed(0.021, certified=True) == []
    assert observed(0.021) == ["uncertified"]


def test_pairs_that_were_apart_must_stay_apart_while_other_pairs_recover(robot: Robot, apart: StepReport) -> None:
    q, v = in_penetration(robot)
    contract = contract_of(robot, q, sample_all=True)
    into_the_table = robot.home.copy()
    into_the_table[1] = 1.0
    assert min(robot.distances(into_the_table), key=lambda pair: pair.distance).name_b == "table_0"
    broken = contract.observe(Reference(into_the_table, v, v, replace(apart, certified=False)), DT)
    assert "bystanders" in broken


@pytest.mark.parametrize("reported", ["closest_distance", "margin"])
def test_a_wrong_distance_is_found_by_coal(robot: Robot, apart: StepReport, reported: str) -> None:
    contract = contract_of(robot, sample_all=True)
    report = replace(apart, **{reported: getattr(apart, reported) + 1e-5})
    assert list(contract.observe(moved(robot.home, np.zeros(14), 0.0, report), DT)) == ["coal"]


def test_a_margin_keeps_the_worst_value_and_counts_nan_as_a_violation() -> None:
    margin = Margin("distance", "m", ">=", 0.0)
    assert all(margin.note(value, tick) for tick, value in enumerate((0.3, 0.1, 0.2), 1))
    assert (margin.worst, margin.tick, margin.violations) == (0.1, 2, 0)
    assert not margin.note(-0.1, 4)
    assert not margin.note(float("nan"), 5)
    assert (margin.violations, margin.tick, margin.checked) == (2, 5, 5)
