"""Each number is what its definition says, of episodes of which everything is known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.config.teleop import Stance
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.judging.figures import figures_of, hand_figures, timing_figures
from q2r2_control.judging.motion import arm_figures, delays, idle_share
from q2r2_control.types import Array
from q2r2_control.wording import sentence
from tests.judging.episodes import DT, episode, frame_times
from tests.support.processes import cell

DROPOUT = 0.06


def without(begin: float, end: float) -> Array:
    """Times of poses that are 10 ms apart, but for a gap."""
    t = np.arange(0.0, 4.0, 0.01)
    return t[(t <= begin + 1e-9) | (t >= end - 1e-9)]


class TestHands:
    def test_a_gap_is_as_long_as_it_is_and_its_share_is_of_the_time_engaged(self) -> None:
        found = hand_figures(episode(received=without(1.0, 1.2)), "left", DROPOUT)
        assert (found.arm, found.dropouts) == ("left", 1)
        assert found.longest_gap_s == pytest.approx(0.2)
        assert found.dropout_share == pytest.approx(0.2 / 4.0, abs=2e-3)
        assert found.pose_rate_hz == pytest.approx(0.95 * 100.0, abs=1.0)

    def test_poses_that_cease_are_a_gap_until_the_end(self) -> None:
        found = hand_figures(episode(received=np.arange(0.0, 3.0, 0.01)), "left", DROPOUT)
        assert found.longest_gap_s == pytest.approx(1.0, abs=0.02)
        found = hand_figures(episode(received=()), "left", DROPOUT)
        assert (found.pose_rate_hz, found.dropouts, found.sample_age_ms_p99) == (0.0, 1, None)

    def test_a_gap_while_no_arm_is_engaged_spoils_nothing(self) -> None:
        engaged = np.ones(2000, dtype=bool)
        engaged[500:1500] = False
        found = hand_figures(episode(engaged=engaged, received=without(1.1, 2.9)), "left", DROPOUT)
        assert (found.dropouts, found.dropout_share) == (0, 0.0)
        assert found.pose_rate_hz == pytest.approx(100.0, abs=1.0)

    def test_of_one_that_the_arm_was_paused_by_only_the_time_before_that_counts(self) -> None:
        engaged = np.ones(2000, dtype=bool)
        engaged[575:1500] = False
        found = hand_figures(episode(engaged=engaged, received=without(1.0, 2.9)), "left", DROPOUT)
        assert found.longest_gap_s == pytest.approx(1.9)
        assert found.dropout_share == pytest.approx(0.15 / 2.15, abs=2e-3)

    def test_a_pose_that_is_no_number_is_none_that_came(self) -> None:
        places = np.zeros((400, 3))
        places[100:120] = math.nan
        found = hand_figures(episode(hand_path=places), "left", DROPOUT)
        assert found.unusable_poses == 20
        assert found.longest_gap_s == pytest.approx(0.21)

    def test_a_gap_in_which_ticks_were_lost_is_none(self) -> None:
        number = np.concatenate((np.arange(500), np.arange(600, 2100)))
        of = episode(4.2, received=without(1.0, 1.2))
        keep = {name: values[number] for name, values in vars(of.ticks).items()}
        lossy = replace(of, ticks=replace(of.ticks, **keep), frames=replace(of.frames, at=of.frames.at[:1]))
        assert hand_figures(of, "left", DROPOUT).dropouts == 2
        assert hand_figures(lossy, "left", DROPOUT).dropouts == 1  # the one at the end

    def test_ages_are_from_the_receipt_to_the_tick(self) -> None:
        found = hand_figures(episode(delay=0.03), "left", DROPOUT)
        assert found.sample_age_ms_p50 == pytest.approx(30.0)
        assert found.sample_age_ms_p99 == pytest.approx(30.0)

    def test_stamps_that_are_no_numbers_are_left_out(self) -> None:
        stamps = np.arange(0.0, 4.0, 0.01)
        stamps[5] = math.nan
        stamps[6] = -math.inf
        found = hand_figures(episode(received=stamps), "left", DROPOUT)
        assert found.longest_gap_s == pytest.approx(0.03)

    def test_a_hand_whose_arm_is_never_engaged_has_no_shares(self) -> None:
        found = hand_figures(episode(engaged=np.zeros(2000, dtype=bool)), "left", DROPOUT)
        assert (found.pose_rate_hz, found.dropout_share, found.longest_gap_s) == (None, None, None)


def wander(t: Array) -> Array:
    """A motion of several frequencies, (n, 3) [m]."""
    return np.stack((0.05 * np.sin(4.0 * t), 0.03 * np.sin(7.0 * t + 1.0), 0.02 * np.cos(5.0 * t)), axis=1)


class TestDelays:
    @pytest.mark.parametrize("delay", [0.045, 0.1, 0.237])
    def test_a_tool_that_repeats_its_hand_later_has_that_delay(self, delay: float) -> None:
        stamps = np.arange(0.0, 4.0, 1.0 / 75.0)
        later = wander(frame_times() - delay)
        found = delays(episode(path=later, received=stamps, hand_path=wander(stamps)), "left")
        assert found == pytest.approx((delay, delay), abs=1.5e-3)

    @pytest.mark.parametrize("stance", list(Stance))
    def test_neither_axes_nor_stance_nor_scale_nor_rest_change_it(self, stance: Stance) -> None:
        config = cell()
        teleop = config.teleop.model_copy(update={"stance": stance, "axes": ("+z", "-x", "+y"), "position_scale": 2.0})
        config = config.model_copy(update={"teleop": teleop})
        stamps = np.arange(0.0, 4.0, 1.0 / 75.0)
        moving = wander(np.clip(stamps, 1.5, 3.0))
        tool = 2.0 * wander(np.clip(frame_times() - 0.06, 1.5, 3.0))
        if stance is Stance.MIRROR_REFLECTED:
            tool = tool * (1.0, -1.0, 1.0)
        # World x is the hand's z, world y minus its x, world z its y.
        raw = np.stack((-moving[:, 1], moving[:, 2], moving[:, 0]), axis=1)
        found = delays(episode(path=tool, received=stamps, hand_path=raw, config=config), "left")
        assert found[1] == pytest.approx(0.06, abs=2e-3)

    def test_a_hand_that_rests_a_tool_that_is_held_and_a_hand_of_one_pose_have_none(self) -> None:
        stamps = np.arange(0.0, 4.0, 1.0 / 75.0)
        assert delays(episode(received=stamps, hand_path=wander(stamps)), "left") == [None, None]
        assert delays(episode(path=wander(frame_times())), "left") == [None, None]
        assert delays(episode(received=[1.0]), "left") == [None, None]


class TestArms:
    def test_errors_are_those_of_the_time_engaged(self) -> None:
        engaged = np.zeros(2000, dtype=bool)
        engaged[:1000] = True
        path = np.zeros((400, 3))
        target = path.copy()
        target[:100, 2] = 0.01
        target[100:200, 2] = 0.03
        target[200:, 2] = 1.0
        found = arm_figures(episode(engaged=engaged, path=path, target_path=target), "left")
        assert found.engaged_s == pytest.approx(2.0)
        assert found.position_error_mm_rms == pytest.approx(math.sqrt((10.0**2 + 30.0**2) / 2.0))
        assert found.position_error_mm_p99 == pytest.approx(30.0)
        assert found.rotation_error_deg_rms == 0.0

    def test_the_leash_counts_while_it_drags(self) -> None:
        slip = np.zeros((2000, 2))
        slip[500:1000, 0] = np.linspace(0.0, 0.2, 500)
        slip[1000:, 0] = 0.2
        found = arm_figures(episode(slip=slip), "left")
        assert found.leashed_share == pytest.approx(0.25, abs=2e-3)
        assert found.slip_mm == pytest.approx(200.0)
        assert arm_figures(episode(slip=slip), "right").leashed_share == 0.0

    def test_a_new_anchor_takes_no_slip_back(self) -> None:
        slip = np.zeros((2000, 2))
        slip[500:1000, 0] = 0.1
        slip[1500:, 0] = 0.05
        assert arm_figures(episode(slip=slip), "left").slip_mm == pytest.approx(150.0)

    def test_rejected_targets_and_changes_of_the_gripper_are_counted(self) -> None:
        rejected = np.zeros((2000, 2), dtype=bool)
        rejected[:100, 1] = True
        gripper = np.ones((2000, 2))
        gripper[700:900, 1] = 0.0
        found = arm_figures(episode(rejected=rejected, gripper=gripper), "right")
        assert found.rejected_share == pytest.approx(0.05, abs=1e-4)
        assert found.gripper_changes == 2

    def test_an_arm_that_is_never_engaged_has_no_figures(self) -> None:
        found = arm_figures(episode(engaged=np.zeros(2000, dtype=bool)), "left")
        assert found.engaged_s == 0.0
        assert found.position_error_mm_rms is found.leashed_share is found.ldlj is found.hand_to_tool_ms is None


class TestIdle:
    def test_a_tool_that_stands_is_idle_and_one_that_trembles_too(self) -> None:
        assert idle_share(episode()) == 1.0
        tremor = 4e-4 * np.sin(60.0 * frame_times())[:, None] * np.ones(3)
        assert idle_share(episode(path=tremor)) == 1.0

    def test_a_second_of_motion_and_half_a_second_before_and_after_are_not_idle(self) -> None:
        path = np.zeros((400, 3))
        path[150:, 0] = np.minimum(0.002 * np.arange(250), 0.2)
        assert idle_share(episode(path=path)) == pytest.approx(0.5, abs=0.02)

    def test_a_motion_of_no_engaged_arm_is_idle(self) -> None:
        path = np.linspace(0.0, 0.5, 400)[:, None] * np.ones(3)
        assert idle_share(episode(path=path)) == pytest.approx(0.0)
        assert idle_share(episode(path=path, engaged=np.zeros(2000, dtype=bool))) == 1.0

    def test_a_gripper_that_closes_is_work(self) -> None:
        gripper = np.ones((2000, 2))
        gripper[1000:, 0] = 0.0
        assert idle_share(episode(gripper=gripper)) == pytest.approx(0.75, abs=0.01)


class TestTiming:
    def test_ticks_that_are_missing_in_the_file_are_lost_and_not_missed(self) -> None:
        number = np.concatenate((np.arange(1000), np.arange(1100, 2100)))
        t = DT * (number + 1.0)
        found = timing_figures(episode(number=number, t=t))
        assert (found.lost_ticks, found.missed_ticks, found.late_ticks) == (100, 0, 0)
        assert found.lost_share == pytest.approx(100 / 2100)
        assert found.longest_lost_s == pytest.approx(0.2)

    def test_ticks_that_came_late_are_missed_and_not_lost(self) -> None:
        dt = np.full(2000, DT)
        dt[500], dt[600] = 10.0 * DT, 1.2 * DT
        found = timing_figures(episode(dt=dt, t=np.cumsum(dt)))
        assert (found.lost_ticks, found.missed_ticks, found.late_ticks) == (0, 9, 1)
        assert found.missed_share == pytest.approx(9 / 2009)
        assert found.longest_tick_s == pytest.approx(0.02)
        assert found.longest_lost_s == 0.0

    def test_a_file_has_an_end_where_the_arms_came_to_rest(self) -> None:
        assert timing_figures(episode()).ended
        assert not timing_figures(episode(following=np.ones(2000, dtype=bool))).ended


def test_faults_are_pauses_that_no_operator_asked_for_each_once() -> None:
    jumped = Reason.of(ReasonKind.HAND_JUMPED, distance=0.3)
    pressed, refused = Reason.of(ReasonKind.PRESSED, control="lower button"), Reason(ReasonKind.NOT_ENGAGED)
    events = [
        Event(0.5, "left", "paused", "engaged", pressed),
        Event(1.0, "left", "engaged", "lost", jumped),
        Event(1.0, "right", "engaged", "lost", Reason.of(ReasonKind.LINKED, cause=jumped, arm="left")),
        Event(2.0, "left", "paused", "paused", refused),
        Event(3.0, "right", "pausing", "paused", pressed),
    ]
    (fault,) = figures_of(episode(events=events), DROPOUT).faults
    assert (fault.t, fault.arm, fault.reason) == (1.0, "left", sentence(jumped))


def test_distances_that_are_none_are_not_the_nearest() -> None:
    distance = np.full(2000, 0.3)
    distance[7], distance[8] = 0.05, math.inf
    found = figures_of(episode(distance=distance, margin=np.full(2000, math.inf)), DROPOUT)
    assert found.min_distance_mm == pytest.approx(50.0)
    assert found.min_margin_mm is None
