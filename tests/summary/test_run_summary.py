"""The figures of a run are right, can be written as JSON, and have keys that do not change."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.compliance.impedance import ImpedanceReport
from q2r2_control.compliance.repulsion import WallReport
from q2r2_control.events import CommonReason, Event, Reason
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.run_summary import EVENTS_KEPT, NOTHING_MEASURED, Histogram, RunStatistics, TorqueSummary
from q2r2_control.types import SIDES, ArmTarget, StepReport, StepStatus, moved_by
from tests.support.processes import cell, cell_robot
from tests.viewer.conftest import tick_at

# Scripts and dashboards rely on these keys.
KEYS = (
    "ticks duration_s loop_rate_hz real_time_factor tick_us lateness_us input_to_command_ms arms min_distance_mm "
    "closest_pair max_velocity_ratio max_acceleration_ratio min_position_margin_rad fallback_ticks uncertified_ticks "
    "rejected_targets overruns missed_ticks stretched_s at_rest torque events"
)
ARM_KEYS = (
    "engaged_s position_error_mm_rms rotation_error_deg_rms gripper_changes gripper_held_s gripper_held_by "
    "object_held_s slip_mm_max slip_deg_max yielded_mm_max yielded_deg_max "
    "policy_s interventions intervention_s end_error_mm"
)
REPORT = StepReport(StepStatus.OK, (), (), ("left_a", "right_b"), 0.2, True, False, 0.0, 1e-5)


@pytest.fixture
def statistics() -> RunStatistics:
    return RunStatistics(cell_robot(), cell().control)


def add(
    statistics: RunStatistics, *, error: pin.SE3 | None = None, target: ArmTarget | None = None, **changes: Any
) -> None:
    """Add a tick of 1 ms at home. Both arms are engaged if the tool has an ``error`` relative to its target.

    ``changes`` replaces fields of the tick, or ``q``, ``v``, ``a`` and ``report`` of its reference.
    """
    tick, arms = tick_at(statistics.robot, 0.0), statistics.robot.arms
    motion = {name: changes.pop(name) for name in ("q", "v", "a") if name in changes}
    reference = replace(tick.reference, report=changes.pop("report", REPORT), **motion)
    target = target or ArmTarget(None if error is None else pin.SE3.Identity(), 1.0)
    made: dict[str, Any] = {
        "reference": reference,
        "tools": dict.fromkeys(arms, error or pin.SE3.Identity()),
        "targets": dict.fromkeys(arms, target),
        "engaged": dict.fromkeys(arms, error is not None),
    }
    statistics.add(replace(tick, **(made | changes)))


def test_the_largest_slip_of_an_engagement_is_reported(statistics: RunStatistics) -> None:
    for slip, angle in ((0.0, 0.0), (0.2, np.pi / 6), (0.05, np.pi / 3), (0.0, 0.0)):
        add(statistics, target=ArmTarget(pin.SE3.Identity(), 1.0, slip, angle))
    figures = statistics.summary(1.0).arms
    assert figures["left"].slip_mm_max == pytest.approx(200.0)
    assert figures["left"].slip_deg_max == pytest.approx(60.0)


def test_the_time_for_which_a_gripper_was_not_allowed_to_move_is_reported_with_the_last_pair_that_caused_it(
    statistics: RunStatistics,
) -> None:
    for held in ({"left": ("left_finger", "table")}, {"left": ("left_finger", "right_link_5")}, {}):
        add(statistics, held_grippers=held, dt=0.25)
    figures = statistics.summary(1.0).arms
    assert (figures["left"].gripper_held_s, figures["left"].gripper_held_by) == (0.5, ("left_finger", "right_link_5"))
    assert (figures["right"].gripper_held_s, figures["right"].gripper_held_by) == (0.0, None)


def test_the_json_of_a_run_has_every_key_that_other_programs_read() -> None:
    loop = Pipeline.from_config(cell(), input=ScriptedInput("circle"), plant="kinematic")
    data = json.loads(json.dumps(loop.run(1.0, realtime=False).as_json(), allow_nan=False))
    assert " ".join(data) == KEYS
    assert all(list(data[key]) == ["p50", "p99", "max"] for key in ("tick_us", "lateness_us", "input_to_command_ms"))
    assert {arm: " ".join(figures) for arm, figures in data["arms"].items()} == dict.fromkeys(SIDES, ARM_KEYS)
    assert [(event["arm"], event["from"], event["to"], event["kind"]) for event in data["events"]] == [
        ("left", "idle", "engaged", "pressed"),
        ("right", "idle", "engaged", "pressed"),
    ]
    assert data["events"][0]["t"] == pytest.approx(0.68, abs=0.05)


@pytest.mark.parametrize("angle", [0.0, 1e-7, 0.5, 3.0, np.pi], ids="{:g} rad".format)
def test_the_angle_of_a_rotation_error_is_exact_from_zero_to_half_a_turn(
    statistics: RunStatistics, angle: float
) -> None:
    add(statistics, error=pin.SE3(pin.exp3(np.array([0.0, 0.0, angle])), np.zeros(3)))
    found = statistics.summary(1.0).arms["left"].rotation_error_deg_rms
    assert found == pytest.approx(np.degrees(angle), abs=1e-7)


def test_a_run_without_ticks_gives_valid_json(statistics: RunStatistics) -> None:
    summary = statistics.summary(0.0)
    assert summary.arms["left"].position_error_mm_rms is summary.min_distance_mm is summary.closest_pair is None
    assert (summary.ticks, summary.duration_s, summary.loop_rate_hz) == (0, 0.0, 0.0)
    assert summary.tick_us.p50 is None
    assert summary.at_rest
    json.dumps(summary.as_json(), allow_nan=False)


def test_the_errors_in_a_summary_are_root_mean_squares_over_the_engaged_ticks(statistics: RunStatistics) -> None:
    for metres, radians in ((3e-3, 0.01), (4e-3, 0.02)):
        add(statistics, error=pin.SE3(pin.exp3(np.array([0.0, radians, 0.0])), np.array([0.0, 0.0, metres])))
    add(statistics)
    figures = statistics.summary(1.0).arms["left"]
    assert figures.engaged_s == pytest.approx(0.002)
    assert figures.position_error_mm_rms == pytest.approx(np.sqrt(12.5))
    assert figures.rotation_error_deg_rms == pytest.approx(np.degrees(np.sqrt(0.00025)))


def test_changes_of_a_gripper_are_counted_but_not_its_first_opening(statistics: RunStatistics) -> None:
    for gripper in (0.0, 0.0, 1.0, 1.0, 0.0):
        add(statistics, target=ArmTarget(None, gripper))
    assert statistics.summary(1.0).arms["right"].gripper_changes == 2


def test_the_summary_has_the_worst_ratios_and_margin_of_all_ticks_relative_to_the_limits_in_force() -> None:
    control = cell().control.model_copy(update={"velocity_scale": 0.5, "acceleration_limit": 4.0})
    statistics = RunStatistics(cell_robot(), control)
    add(statistics, v=-0.25 * statistics.robot.velocity_limit, a=np.full(14, -3.0))
    near = statistics.robot.home.copy()
    near[3] = statistics.robot.position_lower[3] + control.position_margin + 0.02
    add(statistics, q=near, v=np.full(14, np.nan))
    summary = statistics.summary(1.0)
    assert summary.max_velocity_ratio == pytest.approx(0.5)
    assert summary.max_acceleration_ratio == pytest.approx(0.75)
    assert summary.min_position_margin_rad == pytest.approx(0.02)


def test_an_acceleration_is_compared_with_the_limit_of_its_own_joint(statistics: RunStatistics) -> None:
    a = np.zeros(14)
    a[[0, 8]] = 3.0, -2.72  # The joints are the left A1 and the right A2, whose limit is lower.
    add(statistics, a=a)
    assert statistics.summary(1.0).max_acceleration_ratio == pytest.approx(2.72 / 5.44)


def test_the_summary_takes_its_counts_and_the_closest_pair_from_the_reports_of_ticks(statistics: RunStatistics) -> None:
    add(statistics)
    add(statistics, report=replace(REPORT, closest_distance=0.03, closest_pair=("tool", "table"), fallback=True))
    add(statistics, report=replace(REPORT, certified=False, rejected=("left", "right")))
    summary = statistics.summary(1.5)
    assert (summary.min_distance_mm, summary.closest_pair) == (pytest.approx(30.0), ("tool", "table"))
    assert (summary.fallback_ticks, summary.uncertified_ticks, summary.rejected_targets) == (1, 1, 2)
    assert (summary.ticks, summary.loop_rate_hz) == (3, pytest.approx(2.0))


@pytest.mark.parametrize(("speed", "at_rest"), [(0.0, True), (0.01, False)])
def test_the_summary_says_whether_the_run_ended_at_rest(statistics: RunStatistics, speed: float, at_rest: bool) -> None:
    add(statistics, v=np.full(14, 0.5))
    add(statistics, v=np.full(14, -speed))
    assert statistics.summary(1.0).at_rest is at_rest


def test_only_the_newest_events_are_kept_so_a_broken_button_cannot_fill_the_memory(statistics: RunStatistics) -> None:
    statistics.events.extend(
        Event(float(i), "left", "a", "b", Reason(CommonReason.OTHER)) for i in range(EVENTS_KEPT + 10)
    )
    events = statistics.summary(1.0).events
    assert len(events) == EVENTS_KEPT
    assert events[-1].t == EVENTS_KEPT + 9


QUIET = ImpedanceReport({}, (), (), (), (), False)
FREE = WallReport(np.zeros(14), (), 0.0, 0.0, ("left_a", "right_b"), 0.2)
HANDS, ELBOWS = ("left_hand", "right_hand"), ("left_elbow", "right_elbow")


@pytest.fixture
def summary() -> TorqueSummary:
    return TorqueSummary({"left": 0.0, "right": 0.0})


def test_the_torque_summary_keeps_extremes_and_counts_each_tick_once_for_any_number_of_joints(
    summary: TorqueSummary,
) -> None:
    pressed = replace(FREE, pressing=(HANDS, ELBOWS), force=30.0, closest_pair=HANDS, closest_distance=0.015)
    summary.add(0.002, replace(QUIET, saturated=("left_A1", "left_A2"), clipped=("right",)), pressed)
    summary.add(0.002, replace(QUIET, rate_limited=("left_A1",), clipped=("right",)), replace(pressed, force=20.0))
    summary.add(0.002, QUIET, FREE)
    assert summary.min_measured_distance_mm == pytest.approx(15.0)
    assert summary.measured_closest_pair == HANDS
    assert summary.pressed_pairs == [ELBOWS, HANDS]
    assert summary.max_wall_force_n == 30.0
    assert (summary.saturated_ticks, summary.rate_limited_ticks, summary.held_ticks) == (1, 1, 0)
    assert summary.off_reference_s == {"left": 0.0, "right": pytest.approx(0.004)}


def test_an_unmeasured_distance_is_not_reported(summary: TorqueSummary) -> None:
    blind = replace(QUIET, held=True), replace(FREE, closest_pair=("", ""), closest_distance=math.nan)
    summary.add(0.001, *blind)
    summary.add(0.001, QUIET, replace(FREE, closest_pair=("", ""), closest_distance=math.inf))
    assert (summary.min_measured_distance_mm, summary.measured_closest_pair) == (None, None)
    summary.add(0.001, QUIET, FREE)
    summary.add(0.001, *blind)
    assert (summary.min_measured_distance_mm, summary.held_ticks) == (pytest.approx(200.0), 2)


@pytest.mark.parametrize("size", [1, 2, 99, 5000])
def test_percentiles_equal_the_percentiles_of_numpy_to_a_thousandth_of_the_unit(size: int) -> None:
    values = np.random.default_rng(size).exponential(3e-4, size)
    histogram = Histogram(1e-3)
    for value in values:
        histogram.add(value)
    found = histogram.percentiles(1e-6)
    expected = 1e6 * np.percentile(values, [50, 99], method="inverted_cdf")
    assert [found.p50, found.p99] == pytest.approx(expected, abs=1.001)
    assert found.max == pytest.approx(1e6 * values.max(), rel=1e-12)


def test_a_histogram_ignores_numbers_that_are_not_finite_and_counts_numbers_beyond_its_range_as_the_largest() -> None:
    histogram = Histogram(1e-3)
    for value in (float("nan"), float("inf"), float("-inf")):
        histogram.add(value)
    assert histogram.percentiles(1e-3) == NOTHING_MEASURED
    for value in (-1e300, 0.2, 0.5, 3.0, 1e300):
        histogram.add(value)
    assert histogram.percentiles(1e-3).p50 == pytest.approx(1e303)


@pytest.mark.parametrize(("off", "followed"), [(0.0, True), (0.256, False)])
def test_if_a_tool_is_far_from_its_reference_at_the_end_its_arm_counts_as_not_following(
    statistics: RunStatistics, off: float, followed: bool
) -> None:
    led = {arm: statistics.robot.tool_pose(statistics.robot.home, arm) for arm in SIDES}
    add(statistics, tools=led | {"left": moved_by(led["left"], np.array([0.0, off, 0.0]))}, q=statistics.robot.home)
    arms = statistics.summary(1.0).arms
    assert arms["left"].end_error_mm == pytest.approx(1e3 * off, abs=1e-6)
    assert (arms["left"].followed, arms["right"].followed) == (followed, True)
