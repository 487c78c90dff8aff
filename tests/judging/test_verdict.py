"""Every threshold discards what is beyond it, keeps what is at it, and says both numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from q2r2_control.config.recording import JudgeSettings
from q2r2_control.judging.figures import EpisodeFigures, Fault, figures_of
from q2r2_control.judging.verdict import verdict_of
from tests.judging.episodes import episode

FIGURES = replace(figures_of(episode(), 0.06), idle_share=0.0)
JUMP = Fault(1.0, "left", "hand_jumped", "a jump")


def changed(of: str = "episode", **changes: Any) -> EpisodeFigures:
    """Figures of which some are others: of the episode, its left arm, its right hand, or its timing."""
    if of == "arm":
        return replace(FIGURES, arms={"left": replace(FIGURES.arms["left"], **changes)})
    if of == "hand":
        return replace(FIGURES, hands={"right": replace(FIGURES.hands["right"], **changes)})
    if of == "timing":
        return replace(FIGURES, timing=replace(FIGURES.timing, **changes))
    return replace(FIGURES, **changes)


# Threshold and its value; a figure at it and beyond it; what the reason says.
CASES: list[tuple[str, float, str, str, Any, Any, str]] = [
    ("min_pose_rate", 30.0, "hand", "pose_rate_hz", 30.0, 29.0, "right hand: poses at 29.0 Hz (at least 30)"),
    ("max_dropout_share", 0.1, "hand", "dropout_share", 0.1, 0.2, "dropouts 20.0 % of the time (at most 10)"),
    ("max_pose_gap", 0.1, "hand", "longest_gap_s", 0.1, 0.3, "no pose for 300.0 ms (at most 100)"),
    ("max_sample_age", 0.1, "hand", "sample_age_ms_p99", 100.0, 150.0, "p99 150.0 ms (at most 100)"),
    ("max_delay", 0.1, "arm", "hand_to_tool_ms", 100.0, 120.0, "later than its hand by 120.0 ms (at most 100)"),
    ("max_rejected_share", 0.1, "arm", "rejected_share", 0.1, 0.2, "unusable targets 20.0 % (at most 10)"),
    ("max_leashed_share", 0.1, "arm", "leashed_share", 0.1, 0.2, "leash dragged 20.0 % of the time (at most 10)"),
    ("max_position_error_rms", 0.01, "arm", "position_error_mm_rms", 10.0, 11.0, "RMS 11.0 mm (at most 10)"),
    ("max_position_error_p99", 0.01, "arm", "position_error_mm_p99", 10.0, 11.0, "p99 11.0 mm (at most 10)"),
    ("max_rotation_error_rms", 0.1, "arm", "rotation_error_deg_rms", 5.7, 5.8, "RMS 5.8 deg (at most 5.73)"),
    ("max_rotation_error_p99", 0.1, "arm", "rotation_error_deg_p99", 5.7, 5.8, "p99 5.8 deg (at most 5.73)"),
    ("min_ldlj", -9.0, "arm", "ldlj", -9.0, -9.5, "LDLJ -9.5 (at least -9)"),
    ("max_idle_share", 0.5, "episode", "idle_share", 0.5, 0.6, "no engaged arm moves 60.0 % (at most 50)"),
    ("max_fallback_share", 0.1, "episode", "fallback_share", 0.1, 0.2, "20.0 % of the ticks (at most 10)"),
    ("max_uncertified_share", 0.0, "episode", "uncertified_share", 0.0, 0.1, "10.0 % of the ticks (at most 0)"),
    ("min_margin", 0.0, "episode", "min_margin_mm", 0.0, -3.0, "margin -3.0 mm (at least 0)"),
    ("max_lost_share", 0.1, "timing", "lost_share", 0.1, 0.2, "in the recording 20.0 % of the ticks (at most 10)"),
    ("max_lost_gap", 0.1, "timing", "longest_lost_s", 0.1, 0.2, "at once 200.0 ms (at most 100)"),
    ("max_missed_share", 0.1, "timing", "missed_share", 0.1, 0.2, "missed 20.0 % of the ticks (at most 10)"),
    ("max_tick_gap", 0.1, "timing", "longest_tick_s", 0.1, 0.2, "stood still for 200.0 ms (at most 100)"),
    ("max_faults", 1, "episode", "faults", [JUMP], 2 * [JUMP], "left arm at 1.00 s: a jump, and 1 more (at most 1)"),
]


@pytest.mark.parametrize(
    ("name", "limit", "of", "figure", "at_it", "beyond", "says"), CASES, ids=[case[0] for case in CASES]
)
def test_a_number_beyond_its_threshold_is_the_one_reason(
    name: str, limit: float, of: str, figure: str, at_it: Any, beyond: Any, says: str
) -> None:
    settings = JudgeSettings.model_validate({name: limit})
    assert verdict_of(changed(of, **{figure: at_it}), settings).line == "keep"
    (reason,) = verdict_of(changed(of, **{figure: beyond}), settings).reasons
    assert reason.name == name
    assert reason.text.endswith(says)
    assert verdict_of(changed(of, **{figure: beyond}), JudgeSettings.model_validate({name: None})).keep


def test_every_threshold_is_tried_here() -> None:
    tried = {case[0] for case in CASES}
    assert set(JudgeSettings.model_fields) - tried == {"dropout", "keep_failed", "needs_end"}


def test_a_failure_is_discarded_unless_failures_are_kept_and_a_run_that_a_fault_ended_always() -> None:
    assert verdict_of(changed(success=True), JudgeSettings()).keep
    failed = changed(success=False)
    assert [reason.name for reason in verdict_of(failed, JudgeSettings()).reasons] == ["keep_failed"]
    assert verdict_of(failed, JudgeSettings(keep_failed=True)).keep
    ended = changed(ended_by="left_A3 stands still")
    assert verdict_of(ended, JudgeSettings()).line == "discard: a fault ended the run: left_A3 stands still"


def test_a_number_that_is_none_is_not_judged_and_one_that_is_no_number_is_discarded() -> None:
    assert verdict_of(changed("arm", ldlj=None, hand_to_tool_ms=None), JudgeSettings()).keep
    assert not verdict_of(changed("arm", ldlj=float("nan")), JudgeSettings()).keep
    assert not verdict_of(changed("arm", position_error_mm_rms=float("nan")), JudgeSettings()).keep


def test_damage_and_a_missing_end_are_named_before_all_else() -> None:
    endless = changed("timing", ended=False)
    found = verdict_of(replace(endless, damage="damaged: a chunk", duration_s=2.0), JudgeSettings())
    assert [reason.text for reason in found.reasons] == ["after 2.00 s damaged: a chunk"]
    assert [reason.name for reason in verdict_of(endless, JudgeSettings()).reasons] == ["needs_end"]
    assert verdict_of(endless, JudgeSettings(needs_end=False)).keep
