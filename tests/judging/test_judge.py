"""Clean episodes are kept. An episode with one fault is discarded, and the verdict names this fault."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.recording import JudgeSettings
from q2r2_control.inputs.played import PlayedInput
from q2r2_control.judging.camera_figures import CameraFigures
from q2r2_control.judging.figures import EpisodeFigures, Fault, figures_of
from q2r2_control.judging.judge import VERDICT_FILE, Judged, Unreadable, judge, judge_all, keep_verdicts, verdict_of
from q2r2_control.recording.reader import Recording
from q2r2_control.types import SIDES, HandInputs
from tests.judging.episodes import (
    START,
    Late,
    WithDropouts,
    Work,
    at,
    eased,
    episode,
    hands,
    killed,
    record_episode,
    without_ticks,
)
from tests.judging.spoilers import Contents, spoiled
from tests.recording.runs import rewrite

pytestmark = pytest.mark.slow

SEED = 0


def judged(file: Path) -> Judged:
    (whole,) = judge(Recording(file))
    return whole


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("episodes")


@pytest.fixture(scope="module")
def clean(folder: Path) -> Path:
    return record_episode(folder / "clean", hands(SEED))


def test_an_episode_of_clean_work_is_kept(clean: Path) -> None:
    found = judged(clean)
    assert found.verdict.line == "keep"
    for arm in found.figures.arms.values():
        # The filters delay the target by 35 ms. At the start of a motion, the tool lags behind the target.
        assert arm.hand_to_target_ms == pytest.approx(33.0, abs=6.0)
        assert arm.hand_to_tool_ms == pytest.approx(49.0, abs=8.0)
        assert arm.gripper_changes == 1


NOISE = np.random.default_rng(SEED).normal(0.0, 6e-3, (2, 1000, 3))


def jerky(hand: str, t: float) -> pin.SE3:
    smooth = Work(SEED)(hand, t)
    return pin.SE3(smooth.rotation, smooth.translation + NOISE[SIDES.index(hand), round(75.0 * t)])


def jumps(hand: str, t: float) -> pin.SE3:
    return at(hand, x=0.4) if hand == "left" and t > 3.5 else Work(SEED)(hand, t)


def reaches_too_far(hand: str, t: float) -> pin.SE3:
    return at(hand, x=0.9 * eased(t, START, 2.5))


def meets_the_other(hand: str, t: float) -> pin.SE3:
    side = -1.0 if hand == "left" else 1.0
    return at(hand, y=side * 0.27 * eased(t, START, 1.5))


def rests(hand: str, t: float) -> pin.SE3:
    return Work(SEED)(hand, min(t, 0.8))


def engages(hand: str, t: float) -> HandInputs:
    return HandInputs(button_lower=0.2 <= t < 0.3)


SPOILED: dict[str, tuple[PlayedInput, set[str]]] = {
    "dropouts": (hands(SEED, sampling=WithDropouts), {"max_dropout_share"}),
    "hands that come late": (hands(SEED, played=Late), {"max_sample_age", "max_delay"}),
    "a jump": (hands(pose=jumps), {"max_faults"}),
    "the leash dragged": (
        hands(pose=reaches_too_far),
        {"max_leashed_share", "max_position_error_rms", "max_position_error_p99", "max_rotation_error_rms"},
    ),
    "held by the other arm": (hands(pose=meets_the_other), {"max_position_error_rms"}),
    "hands that rest": (hands(pose=rests, inputs=engages), {"max_idle_share"}),
    "jerky hands": (hands(pose=jerky), {"min_ldlj"}),
}


@pytest.mark.parametrize("what", SPOILED)
def test_an_episode_with_one_fault_is_discarded_for_this_fault_only(what: str, folder: Path) -> None:
    source, reasons = SPOILED[what]
    found = judged(record_episode(folder / what, source))
    assert {reason.name for reason in found.verdict.reasons} == reasons, found.verdict.line
    assert found.verdict.word == "discard"


def test_lost_ticks_are_named_and_the_samples_that_were_lost_with_them_do_not_count_as_dropouts(
    clean: Path, tmp_path: Path
) -> None:
    found = judged(without_ticks(clean, tmp_path / "lost.mcap", 500, 25))
    assert {reason.name for reason in found.verdict.reasons} == {"max_lost_share", "max_lost_gap"}
    assert found.figures.timing.lost_ticks == 25
    assert found.figures.timing.longest_lost_s == pytest.approx(0.1)
    assert found.figures.timing.missed_ticks == 0


def test_a_recording_whose_process_was_killed_is_discarded_for_this_reason_only(clean: Path, tmp_path: Path) -> None:
    found = judged(killed(clean, tmp_path / "killed.mcap", 800))
    assert [reason.name for reason in found.verdict.reasons] == ["needs_end"]
    assert found.figures.timing.ticks == 800
    (kept,) = judge(Recording(tmp_path / "killed.mcap"), JudgeSettings(needs_end=False))
    assert kept.verdict.keep


def test_a_damaged_recording_is_judged_by_the_part_before_the_damage(clean: Path, tmp_path: Path) -> None:
    damaged = rewrite(clean, tmp_path / "damaged.mcap", lambda _, message: message)
    data = bytearray(damaged.read_bytes())
    chunk = data.rindex(b"\x28\xb5\x2f\xfd")  # These bytes begin a chunk of zstd.
    data[chunk + 200] ^= 0xFF
    damaged.write_bytes(data)
    found = judged(damaged)
    assert found.verdict.reasons[0].name == "damaged"
    lost = judged(clean).figures.timing.ticks - found.figures.timing.ticks
    assert 0 < lost <= 50, "the ticks of the last chunk"
    (tmp_path / "cut.mcap").write_bytes(clean.read_bytes()[:-5000])
    assert "needs_end" in {reason.name for reason in judged(tmp_path / "cut.mcap").verdict.reasons}


def test_a_run_in_which_no_arm_was_engaged_is_discarded_for_this_reason_only(tmp_path: Path) -> None:
    found = judged(record_episode(tmp_path, hands(SEED, inputs=lambda hand, t: HandInputs()), 0.5))
    assert [reason.name for reason in found.verdict.reasons] == ["never_engaged"]


@pytest.mark.parametrize(("ticks", "says"), [(0, {"no_ticks", "needs_end"}), (1, {"needs_end"})])
def test_a_recording_with_one_tick_or_no_tick_is_discarded(
    ticks: int, says: set[str], clean: Path, tmp_path: Path
) -> None:
    found = judged(killed(clean, tmp_path / "few.mcap", ticks))
    assert {reason.name for reason in found.verdict.reasons} == says | {"never_engaged"}
    json.dumps(found.as_json(), allow_nan=False)


def test_a_verdict_is_written_beside_its_recording_with_all_figures_and_thresholds(clean: Path, tmp_path: Path) -> None:
    file = Path(shutil.copy(clean, tmp_path))
    written = keep_verdicts([judged(file)])
    assert written == tmp_path / VERDICT_FILE
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([file.name, VERDICT_FILE])
    kept = json.loads(written.read_text())
    assert (kept["format"], kept["recording"]) == (2, file.name)
    (episode,) = kept["episodes"]
    assert (episode["verdict"], episode["reasons"]) == ("keep", [])
    assert JudgeSettings.model_validate(kept["thresholds"]) == JudgeSettings()
    assert episode["figures"]["arms"]["left"]["gripper_changes"] == 1


def test_files_that_cannot_be_read_are_named_and_the_other_files_are_judged(clean: Path, tmp_path: Path) -> None:
    files = {"notes": b"no recording", "empty": b"", "magic": clean.read_bytes()[:8]}
    for name, data in files.items():
        (tmp_path / f"{name}.mcap").write_bytes(data)
    degrees = spoiled(clean, tmp_path / "degrees.mcap", in_degrees)
    swapped = spoiled(clean, tmp_path / "swapped.mcap", swapped_arms)
    bad = [*sorted(tmp_path.glob("[emn]*.mcap")), degrees, swapped]
    *found, last = judge_all([*bad, clean])
    assert isinstance(last, Judged)
    assert [one.file for one in found if isinstance(one, Unreadable)] == bad
    for one in found:
        assert isinstance(one, Unreadable)
        assert one.line.startswith("discard: unreadable, ")
        assert str(one.file) not in one.line


def swapped_arms(contents: Contents) -> None:
    for name in ("q", "v", "reference_q", "reference_v"):
        contents.rows[name] = np.roll(contents.rows[name], contents.rows[name].shape[1] // 2, axis=1)


def in_degrees(contents: Contents) -> None:
    for name in ("q", "reference_q"):
        contents.rows[name] = np.degrees(contents.rows[name])


FIGURES = replace(figures_of(episode(), 0.06), idle_share=0.0)
CAMERA = CameraFigures(None, 60, 0, 1.0, 1.0, 0.0, 0.0, 0, 0.0, None)
JUMP = Fault(1.0, "left", "hand_jumped", "a jump")


def changed(of: str = "episode", **changes: Any) -> EpisodeFigures:
    if of == "arm":
        return replace(FIGURES, arms={"left": replace(FIGURES.arms["left"], **changes)})
    if of == "hand":
        return replace(FIGURES, hands={"right": replace(FIGURES.hands["right"], **changes)})
    if of == "measured":
        return replace(FIGURES, measured={"right": replace(FIGURES.measured["right"], **changes)})
    if of == "camera":
        return replace(FIGURES, cameras={"above": replace(CAMERA, **changes)})
    if of == "timing":
        return replace(FIGURES, timing=replace(FIGURES.timing, **changes))
    return replace(FIGURES, **changes)


# Columns 1 and 2: the name and the value of a threshold.
# Columns 3 and 4: the group and the name of the figure that the threshold limits.
# Columns 5 and 6: a value of the figure at the limit, and a value beyond the limit.
# Column 7: the end of the text of the reason.
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
    ("max_unmeasured_ticks", 2, "measured", "unmeasured_ticks", 2, 3, "are no numbers in 3.0 ticks (at most 2)"),
    ("max_joint_speed", 1.2, "measured", "joint_speed_share", 1.2, 9.0, "moves at 9.0 of its limit (at most 1.2)"),
    ("max_velocity_mismatch", 0.5, "measured", "velocity_mismatch", 0.5, 2.0, "off by 200.0 % (at most 50)"),
    ("max_reference_lag", 0.1, "measured", "reference_lag_ms", -100.0, -200.0, "by -200.0 ms (at most 100)"),
    (
        "min_picture_rate_share",
        0.8,
        "camera",
        "rate_share",
        0.8,
        0.5,
        "50.0 % of the pictures that were due (at least 80)",
    ),
    ("max_picture_gap", 3.0, "camera", "longest_gap_periods", 3.0, 4.0, "for 4.0 of its periods (at most 3)"),
    ("max_frozen_share", 0.2, "camera", "frozen_share", 0.2, 0.5, "while arms move 50.0 % of the time (at most 20)"),
    ("max_black_share", 0.1, "camera", "black_share", 0.1, 0.2, "one colour 20.0 % of the pictures (at most 10)"),
    ("max_bad_pictures", 1, "camera", "bad_pictures", 1, 2, "than the cell's: 2.0 pictures (at most 1)"),
    (
        "max_picture_lag",
        0.1,
        "camera",
        "lag_ms",
        100.0,
        200.0,
        "camera above: pictures are later than the arms by 200.0 ms (at most 100)",
    ),
    ("max_faults", 1, "episode", "faults", [JUMP], 2 * [JUMP], "left arm at 1.00 s: a jump, and 1 more (at most 1)"),
]


def test_a_reason_that_concerns_a_camera_says_how_many_of_its_pictures_are_missing() -> None:
    figures = changed("camera", missing_pictures=12, longest_gap_periods=13.0)
    says = "discard: camera above: 12 pictures missing, no picture for 13.0 of its periods (at most 2.5)"
    assert verdict_of(figures, JudgeSettings()).line == says


def test_cameras_with_the_same_finding_are_named_together_after_the_other_reasons() -> None:
    figures = changed("camera", missing_pictures=12, rate_share=0.5, longest_gap_periods=13.0)
    (camera,) = figures.cameras.values()
    figures = replace(figures, cameras={"above": camera, "front": camera}, faults=[JUMP])
    fault, *of_cameras = verdict_of(figures, JudgeSettings(max_faults=0)).findings
    assert fault.startswith("fault: ")
    assert of_cameras == [
        "cameras above, front: 12 pictures missing, there are 50.0 % of the pictures that were due (at least 80)",
        "cameras above, front: no picture for 13.0 of its periods (at most 2.5)",
    ]


@pytest.mark.parametrize(
    ("name", "limit", "of", "figure", "at_it", "beyond", "says"), CASES, ids=[case[0] for case in CASES]
)
def test_an_episode_with_one_figure_beyond_its_threshold_is_discarded_for_this_figure_only(
    name: str, limit: float, of: str, figure: str, at_it: Any, beyond: Any, says: str
) -> None:
    settings = JudgeSettings.model_validate({name: limit})
    assert verdict_of(changed(of, **{figure: at_it}), settings).line == "keep"
    (reason,) = verdict_of(changed(of, **{figure: beyond}), settings).reasons
    assert reason.name == name
    assert reason.text.endswith(says)
    assert verdict_of(changed(of, **{figure: beyond}), JudgeSettings.model_validate({name: None})).keep


def test_this_file_tests_every_threshold_of_episodes() -> None:
    tried = {case[0] for case in CASES}
    # These thresholds are tested in tests/recording/test_subtasks.py.
    of_subtasks = {"min_subtask_time", "max_subtask_time", "needs_subtasks"}
    others = {"dropout", "keep_failed", "needs_end", "needs_task"}
    assert set(JudgeSettings.model_fields) - tried == others | of_subtasks


def test_a_failed_episode_is_discarded_unless_failures_are_kept_and_a_run_that_a_fault_ended_is_discarded_too() -> None:
    assert verdict_of(changed(success=True), JudgeSettings()).keep
    failed = changed(success=False)
    assert [reason.name for reason in verdict_of(failed, JudgeSettings()).reasons] == ["keep_failed"]
    assert verdict_of(failed, JudgeSettings(keep_failed=True)).keep
    ended = changed(ended_by="left_A3 stands still")
    assert [reason.name for reason in verdict_of(ended, JudgeSettings()).reasons] == ["ended_by"]


def test_a_missing_figure_is_not_judged_but_an_episode_with_a_figure_that_is_not_finite_is_discarded() -> None:
    assert verdict_of(changed("arm", ldlj=None, hand_to_tool_ms=None), JudgeSettings()).keep
    assert not verdict_of(changed("arm", ldlj=float("nan")), JudgeSettings()).keep
    assert not verdict_of(changed("arm", position_error_mm_rms=float("nan")), JudgeSettings()).keep
