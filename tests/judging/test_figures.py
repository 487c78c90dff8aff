"""Each figure of an episode agrees with its definition. The test makes the episodes, so it knows the right values."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from q2r2_control.config.teleop import Stance
from q2r2_control.events import Event, Reason
from q2r2_control.inputs.way_points import minimum_jerk
from q2r2_control.judging.episode import FRAME
from q2r2_control.judging.figures import HandFigures, figures_of, hand_figures, timing_figures
from q2r2_control.judging.motion import arm_figures, delays, idle_share, ldlj, smoothness
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import Array, Flags
from q2r2_control.wording import sentence
from tests.judging.episodes import DT, episode, frame_times
from tests.support.processes import cell

DROPOUT = 0.06
NEVER = np.zeros(2000, dtype=bool)


def hand(**what: Any) -> HandFigures:
    return hand_figures(episode(**what), "left", DROPOUT)


def without(begin: float, end: float) -> Array:
    """Return times of poses that are 10 ms apart [s], with a gap from ``begin`` to ``end`` [s]."""
    t = np.arange(0.0, 4.0, 0.01)
    return t[(t <= begin + 1e-9) | (t >= end - 1e-9)]


def engaged_until(first: int, again: int) -> Flags:
    """Return flags (2000,) of an arm that is engaged except in the ticks from ``first`` to ``again``."""
    at = np.arange(2000)
    return (at < first) | (at >= again)


class TestHands:
    def test_the_length_of_a_gap_is_exact_and_the_dropout_share_is_relative_to_the_engaged_time(self) -> None:
        found = hand(received=without(1.0, 1.2), delay=0.03)
        assert (found.arm, found.dropouts) == ("left", 1)
        assert (found.sample_age_ms_p50, found.sample_age_ms_p99) == pytest.approx((30.0, 30.0))
        assert found.longest_gap_s == pytest.approx(0.2)
        assert found.dropout_share == pytest.approx(0.2 / 4.0, abs=2e-3)
        assert found.pose_rate_hz == pytest.approx(0.95 * 100.0, abs=1.0)

    def test_after_the_last_pose_there_is_a_gap_until_the_end_of_the_episode(self) -> None:
        assert hand(received=np.arange(0.0, 3.0, 0.01)).longest_gap_s == pytest.approx(1.0, abs=0.02)
        found = hand(received=())
        assert (found.pose_rate_hz, found.dropouts, found.sample_age_ms_p99) == (0.0, 1, None)

    def test_a_hand_has_no_gap_while_a_policy_moves_its_arm(self) -> None:
        by_policy = np.zeros((2000, 2), dtype=bool)
        assert hand(received=(), by_policy=~by_policy).longest_gap_s is None
        by_policy[500:1500] = True
        assert hand(received=without(1.1, 2.9), by_policy=by_policy).dropouts == 0

    def test_only_the_engaged_part_of_a_gap_counts(self) -> None:
        found = hand(engaged=engaged_until(500, 1500), received=without(1.1, 2.9))
        assert (found.dropouts, found.dropout_share) == (0, 0.0)
        assert found.pose_rate_hz == pytest.approx(100.0, abs=1.0)
        found = hand(engaged=engaged_until(575, 1500), received=without(1.0, 2.9))
        assert found.longest_gap_s == pytest.approx(1.9)
        assert found.dropout_share == pytest.approx(0.15 / 2.15, abs=2e-3)

    def test_a_pose_or_a_stamp_that_is_not_finite_does_not_count(self) -> None:
        places, stamps = np.zeros((400, 3)), np.arange(0.0, 4.0, 0.01)
        places[100:120] = math.nan
        found = hand(hand_path=places)
        assert found.unusable_poses == 20
        assert found.longest_gap_s == pytest.approx(0.21)
        stamps[5], stamps[6] = math.nan, -math.inf
        assert hand(received=stamps).longest_gap_s == pytest.approx(0.03)

    def test_a_gap_caused_by_lost_ticks_does_not_count_as_a_dropout(self) -> None:
        number = np.concatenate((np.arange(500), np.arange(600, 2100)))
        of = episode(4.2, received=without(1.0, 1.2))
        keep = {name: values[number] for name, values in vars(of.ticks).items()}
        lossy = replace(of, ticks=replace(of.ticks, **keep), frames=replace(of.frames, at=of.frames.at[:1]))
        assert hand_figures(of, "left", DROPOUT).dropouts == 2
        assert hand_figures(lossy, "left", DROPOUT).dropouts == 1  # The time after the last pose is a dropout.

    def test_a_hand_whose_arm_is_never_engaged_has_no_pose_rate_and_no_figures_of_gaps(self) -> None:
        found = hand(engaged=NEVER)
        assert (found.pose_rate_hz, found.dropout_share, found.longest_gap_s) == (None, None, None)


def wander(t: Array) -> Array:
    return np.stack((0.05 * np.sin(4.0 * t), 0.03 * np.sin(7.0 * t + 1.0), 0.02 * np.cos(5.0 * t)), axis=1)


class TestDelays:
    stamps = np.arange(0.0, 4.0, 1.0 / 75.0)

    @pytest.mark.parametrize("delay", [0.045, 0.1, 0.237])
    def test_the_delay_of_a_tool_behind_its_hand_is_found(self, delay: float) -> None:
        later = wander(frame_times() - delay)
        found = delays(episode(path=later, received=self.stamps, hand_path=wander(self.stamps)), "left")
        assert found == pytest.approx((delay, delay), abs=1.5e-3)

    @pytest.mark.parametrize("stance", list(Stance))
    def test_axes_stance_scale_and_time_at_rest_do_not_change_the_found_delay(self, stance: Stance) -> None:
        config = cell()
        teleop = config.teleop.model_copy(update={"stance": stance, "axes": ("+z", "-x", "+y"), "position_scale": 2.0})
        config = config.model_copy(update={"teleop": teleop})
        moving = wander(np.clip(self.stamps, 1.5, 3.0))
        tool = 2.0 * wander(np.clip(frame_times() - 0.06, 1.5, 3.0))
        if stance is Stance.MIRROR_REFLECTED:
            tool = tool * (1.0, -1.0, 1.0)
        # The world's x is the hand's z, its y is minus the hand's x, and its z is the hand's y.
        raw = np.stack((-moving[:, 1], moving[:, 2], moving[:, 0]), axis=1)
        found = delays(episode(path=tool, received=self.stamps, hand_path=raw, config=config), "left")
        assert found[1] == pytest.approx(0.06, abs=2e-3)

    def test_a_resting_hand_a_held_tool_and_a_hand_with_one_pose_have_no_delay(self) -> None:
        assert delays(episode(received=self.stamps, hand_path=wander(self.stamps)), "left") == [None, None]
        assert delays(episode(path=wander(frame_times())), "left") == [None, None]
        assert delays(episode(received=[1.0]), "left") == [None, None]


class TestArms:
    def test_errors_are_computed_from_the_engaged_time_only(self) -> None:
        path, target = np.zeros((400, 3)), np.zeros((400, 3))
        target[:100, 2], target[100:200, 2], target[200:, 2] = 0.01, 0.03, 1.0
        found = arm_figures(episode(engaged=engaged_until(1000, 2000), path=path, target_path=target), "left")
        assert found.engaged_s == pytest.approx(2.0)
        assert found.position_error_mm_rms == pytest.approx(math.sqrt((10.0**2 + 30.0**2) / 2.0))
        assert found.position_error_mm_p99 == pytest.approx(30.0)
        assert found.rotation_error_deg_rms == 0.0

    def test_only_time_in_which_the_slip_grows_counts_as_leashed_and_slips_of_all_engagements_are_added(self) -> None:
        slip = np.zeros((2000, 2))
        slip[500:1000, 0] = np.linspace(0.0, 0.2, 500)
        slip[1000:1500, 0], slip[1900:, 0] = 0.2, 0.05
        found = arm_figures(episode(slip=slip), "left")
        assert found.leashed_share == pytest.approx(0.25, abs=2e-3)
        assert found.slip_mm == pytest.approx(250.0)
        assert arm_figures(episode(slip=slip), "right").leashed_share == 0.0

    def test_rejected_targets_and_changes_of_the_gripper_are_counted(self) -> None:
        rejected = np.zeros((2000, 2), dtype=bool)
        rejected[:100, 1] = True
        gripper = np.ones((2000, 2))
        gripper[700:900, 1] = 0.0
        found = arm_figures(episode(rejected=rejected, gripper=gripper), "right")
        assert found.rejected_share == pytest.approx(0.05, abs=1e-4)
        assert found.gripper_changes == 2

    def test_an_arm_that_is_never_engaged_has_no_figures(self) -> None:
        found = arm_figures(episode(engaged=NEVER), "left")
        assert found.engaged_s == 0.0
        assert found.position_error_mm_rms is found.leashed_share is found.ldlj is found.hand_to_tool_ms is None


class TestIdle:
    def test_a_tool_that_rests_or_trembles_or_is_not_engaged_counts_as_idle(self) -> None:
        tremor = 4e-4 * np.sin(60.0 * frame_times())[:, None] * np.ones(3)
        path = np.linspace(0.0, 0.5, 400)[:, None] * np.ones(3)
        assert idle_share(episode(path=path)) == pytest.approx(0.0)
        for idle in (episode(), episode(path=tremor), episode(path=path, engaged=NEVER)):
            assert idle_share(idle) == 1.0

    def test_the_half_second_before_and_after_a_motion_or_a_change_of_the_gripper_does_not_count_as_idle(self) -> None:
        path, gripper = np.zeros((400, 3)), np.ones((2000, 2))
        path[150:, 0] = np.minimum(0.002 * np.arange(250), 0.2)
        assert idle_share(episode(path=path)) == pytest.approx(0.5, abs=0.02)
        gripper[1000:, 0] = 0.0
        assert idle_share(episode(gripper=gripper)) == pytest.approx(0.75, abs=0.01)


class TestTiming:
    def test_ticks_that_are_missing_in_the_file_count_as_lost_and_not_as_missed(self) -> None:
        number = np.concatenate((np.arange(1000), np.arange(1100, 2100)))
        found = timing_figures(episode(number=number, t=DT * (number + 1.0)))
        assert (found.lost_ticks, found.missed_ticks, found.late_ticks) == (100, 0, 0)
        assert found.lost_share == pytest.approx(100 / 2100)
        assert found.longest_lost_s == pytest.approx(0.2)

    def test_ticks_that_are_late_by_less_than_a_period_do_not_count_as_missed(self) -> None:
        dt = np.tile((1.6 * DT, 0.4 * DT), 1000)
        assert timing_figures(episode(dt=dt, t=np.cumsum(dt))).missed_ticks == 0

    def test_periods_that_a_late_loop_skipped_count_as_missed_ticks_and_not_as_lost_ticks(self) -> None:
        dt = np.full(2000, DT)
        dt[500], dt[600] = 10.0 * DT, 1.2 * DT
        found = timing_figures(episode(dt=dt, t=np.cumsum(dt)))
        assert (found.lost_ticks, found.missed_ticks, found.late_ticks) == (0, 9, 1)
        assert found.missed_share == pytest.approx(9 / 2009)
        assert (found.longest_tick_s, found.longest_lost_s) == (pytest.approx(0.02), 0.0)
        assert found.ended
        assert not timing_figures(episode(following=~NEVER)).ended


def test_a_pause_that_no_operator_asked_for_is_one_fault_even_if_it_stops_both_arms() -> None:
    jumped = Reason.of(TeleopReason.HAND_JUMPED, distance=0.3)
    pressed, refused = Reason.of(TeleopReason.PRESSED, control="lower button"), Reason(TeleopReason.NOT_ENGAGED)
    events = [
        Event(0.5, "left", "paused", "engaged", pressed),
        Event(1.0, "left", "engaged", "lost", jumped),
        Event(1.0, "right", "engaged", "lost", Reason.of(TeleopReason.LINKED, cause=jumped, arm="left")),
        Event(2.0, "left", "paused", "paused", refused),
        Event(3.0, "right", "pausing", "paused", pressed),
    ]
    distance = np.full(2000, 0.3)
    distance[7], distance[8] = 0.05, math.inf
    found = figures_of(episode(events=events, distance=distance, margin=np.full(2000, math.inf)), DROPOUT)
    (fault,) = found.faults
    assert (fault.t, fault.arm, fault.reason) == (1.0, "left", sentence(jumped))
    assert (found.min_distance_mm, found.min_margin_mm) == (pytest.approx(50.0), None), "inf: none is near"


def reach(duration: float = 1.0, way: float = 0.2) -> Array:
    share = np.array([minimum_jerk(t / duration) for t in np.arange(0.0, duration + 0.5 * FRAME, FRAME)])
    return way * share[:, None] * np.array([0.6, 0.0, 0.8])


def to_and_fro(seconds: float, noise: float = 0.0) -> tuple[Array, Array]:
    t = np.arange(0.0, seconds, FRAME)
    phase = np.array([minimum_jerk(time % 1.0) for time in t])
    share = np.where(np.floor(t) % 2 == 0, phase, 1.0 - phase)
    place = 0.2 * share[:, None] * np.array([0.6, 0.0, 0.8])
    return t, place + np.random.default_rng(0).normal(0.0, noise, place.shape)


def test_the_dimensionless_jerk_of_a_minimum_jerk_motion_has_its_theoretical_value() -> None:
    # For x(s) = 10 s^3 - 15 s^4 + 6 s^5, the integral of the squared jerk is 720, and the peak speed is 15 / 8.
    assert ldlj(reach(), FRAME) == pytest.approx(-np.log(720.0 / (15.0 / 8.0) ** 2), abs=0.12)
    # The value does not depend on the size of a motion. It is lower if the motion stops and starts again.
    assert ldlj(reach(way=0.02), FRAME) == pytest.approx(ldlj(reach(way=0.5), FRAME), rel=1e-6)
    shorter = reach(0.25, 0.05)
    in_four = np.concatenate([shorter[:-1] + step * shorter[-1] for step in range(4)])
    assert ldlj(in_four, FRAME) < ldlj(reach(), FRAME) - 0.5


def test_smoothness_does_not_depend_on_the_length_of_an_episode_but_noise_makes_it_smaller() -> None:
    short, long, noisy = (
        smoothness(*to_and_fro(seconds, noise), np.ones(int(seconds / FRAME), dtype=bool))
        for seconds, noise in ((4.0, 0.0), (8.0, 0.0), (4.0, 1e-3))
    )
    assert short == pytest.approx(long, abs=0.05)
    assert noisy is not None
    assert short is not None
    assert noisy < short - 3.0


def test_only_the_motion_of_an_engaged_arm_counts_for_smoothness() -> None:
    t, place = to_and_fro(8.0)
    place[400:] = place[400]
    engaged = np.ones(800, dtype=bool)
    assert smoothness(t, place, engaged) == pytest.approx(smoothness(t[:500], place[:500], engaged[:500]), abs=0.1)
    engaged[:400] = False
    assert smoothness(t, place, engaged) is None


def test_neither_tremor_at_rest_nor_a_gap_in_the_file_counts_as_motion() -> None:
    t = np.arange(0.0, 4.0, FRAME)
    place = 2e-4 * np.sin(60.0 * t)[:, None] * np.array([1.0, 0.0, 0.0])
    assert smoothness(t, place, np.ones(len(t), dtype=bool)) is None
    t, place = to_and_fro(6.0)
    there = t % 0.5 < 0.4
    assert smoothness(t[there], place[there], np.ones(there.sum(), dtype=bool)) is None
    t, place = to_and_fro(6.0)
    place[10] = np.nan
    found = smoothness(t, place, np.ones(600, dtype=bool))
    assert found == pytest.approx(smoothness(t[11:], place[11:], np.ones(589, dtype=bool)))
