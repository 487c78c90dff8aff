"""Clean episodes are kept; each of those that were spoiled in one way is discarded, for that reason."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.recording import JudgeSettings
from q2r2_control.errors import RecordingError
from q2r2_control.inputs.base import Input
from q2r2_control.judging.judge import VERDICT_FILE, Judged, judge, judge_all, keep_verdicts
from q2r2_control.recording.reader import Recording
from q2r2_control.types import HandInputs
from tests.judging.runs import (
    START,
    Held,
    Pose,
    Thinned,
    Work,
    at,
    eased,
    hands,
    headset,
    killed,
    record_episode,
    without_ticks,
)

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


@pytest.mark.parametrize("seed", range(1, 6))
def test_clean_work_is_kept(seed: int, folder: Path) -> None:
    found = judged(record_episode(folder / str(seed), hands(seed)))
    assert found.verdict.line == "keep"
    for arm in found.figures.arms.values():
        # Filters of 45 ms, and a controller that lets a motion that begins lag.
        assert arm.hand_to_target_ms == pytest.approx(42.0, abs=6.0)
        assert arm.hand_to_tool_ms == pytest.approx(58.0, abs=8.0)
        assert arm.gripper_changes == 1


def jerky() -> Pose:
    """Work of a hand that starts and stops all the time."""
    work, random = Work(SEED), np.random.default_rng(SEED)
    noise = {hand: random.normal(0.0, 6e-3, (1000, 3)) for hand in ("left", "right")}

    def pose(hand: str, t: float) -> pin.SE3:
        smooth = work(hand, t)
        return pin.SE3(smooth.rotation, smooth.translation + noise[hand][round(75.0 * t)])

    return pose


def jumps(hand: str, t: float) -> pin.SE3:
    place = Work(SEED)(hand, t)
    return at(hand, x=0.4) if hand == "left" and t > 3.5 else place


def reaches_too_far(hand: str, t: float) -> pin.SE3:
    return at(hand, x=0.9 * eased(t, START, 2.5))


def meets_the_other(hand: str, t: float) -> pin.SE3:
    side = -1.0 if hand == "left" else 1.0
    return at(hand, y=side * 0.27 * eased(t, START, 1.5))


def rests(hand: str, t: float) -> pin.SE3:
    return Work(SEED)(hand, min(t, 0.8))


def engages(hand: str, t: float) -> HandInputs:
    return HandInputs(button_lower=0.2 <= t < 0.3)


SPOILED: dict[str, tuple[Callable[[], Input], set[str]]] = {
    "dropouts": (
        lambda: hands(
            SEED, sampling=lambda hand, seed: Thinned(headset(hand, seed), lambda t: t > 0.6 and t % 0.4 < 0.08)
        ),
        {"max_dropout_share"},
    ),
    "hands that come late": (lambda: Held(hands(SEED), 0.08), {"max_sample_age", "max_delay"}),
    "a jump": (lambda: hands(pose=jumps), {"max_faults"}),
    "the leash dragged": (
        lambda: hands(pose=reaches_too_far),
        {"max_leashed_share", "max_position_error_rms", "max_position_error_p99", "max_rotation_error_rms"},
    ),
    "held by the other arm": (
        lambda: hands(pose=meets_the_other),
        {"max_position_error_rms"},
    ),
    "hands that rest": (lambda: hands(pose=rests, inputs=engages), {"max_idle_share"}),
    "jerky hands": (lambda: hands(pose=jerky()), {"min_ldlj"}),
}


@pytest.mark.parametrize("what", SPOILED)
def test_an_episode_that_is_spoiled_in_one_way_is_discarded_for_that_reason(what: str, folder: Path) -> None:
    source, reasons = SPOILED[what]
    found = judged(record_episode(folder / what, source()))
    assert {reason.name for reason in found.verdict.reasons} == reasons, found.verdict.line
    assert found.verdict.word == "discard"


def test_ticks_that_were_lost_are_named_and_their_samples_are_not_taken_for_dropouts(
    clean: Path, tmp_path: Path
) -> None:
    found = judged(without_ticks(clean, tmp_path / "lost.mcap", 500, 25))
    assert {reason.name for reason in found.verdict.reasons} == {"max_lost_share", "max_lost_gap"}
    assert found.figures.timing.lost_ticks == 25
    assert found.figures.timing.longest_lost_s == pytest.approx(0.1)
    assert found.figures.timing.missed_ticks == 0


def test_a_recording_whose_process_was_killed_says_so_alone(clean: Path, tmp_path: Path) -> None:
    found = judged(killed(clean, tmp_path / "killed.mcap", 800))
    assert [reason.name for reason in found.verdict.reasons] == ["needs_end"]
    assert found.figures.timing.ticks == 800
    (kept,) = judge(Recording(tmp_path / "killed.mcap"), JudgeSettings(needs_end=False))
    assert kept.verdict.keep


def test_a_damaged_recording_is_judged_by_what_is_before_the_damage(clean: Path, tmp_path: Path) -> None:
    data = bytearray(clean.read_bytes())
    chunk = data.rindex(b"\x28\xb5\x2f\xfd")  # of zstd
    data[chunk + 200] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    found = judged(tmp_path / "damaged.mcap")
    assert found.verdict.reasons[0].name == "damaged"
    assert "damaged: " in found.verdict.line
    (tmp_path / "cut.mcap").write_bytes(clean.read_bytes()[:-5000])
    assert "needs_end" in {reason.name for reason in judged(tmp_path / "cut.mcap").verdict.reasons}


def test_a_run_in_which_no_arm_was_engaged_says_only_that(tmp_path: Path) -> None:
    found = judged(record_episode(tmp_path, hands(SEED, inputs=lambda hand, t: HandInputs()), 0.5))
    assert found.verdict.line == "discard: no arm was ever engaged"


def test_one_tick_and_no_tick_are_no_episode(clean: Path, tmp_path: Path) -> None:
    for ticks in (0, 1):
        found = judged(killed(clean, tmp_path / f"{ticks}.mcap", ticks))
        assert {reason.name for reason in found.verdict.reasons} == {"needs_end", "never_engaged"}
        json.dumps(found.as_json(), allow_nan=False)


def test_where_the_operator_rests_changes_nothing(folder: Path) -> None:
    """The same two reaches behind a rest and before one, engaged all the time."""
    first, last = (
        judged(record_episode(folder / name, hands(4, pose=Work(4, begin, reaches=2)), 4.8))
        for name, begin in (("rest first", START + 1.5), ("rest last", START))
    )
    assert first.verdict.line == last.verdict.line == "keep"
    assert first.figures.idle_share == pytest.approx(last.figures.idle_share, abs=0.05)
    for arm, one in first.figures.arms.items():
        other = last.figures.arms[arm]
        assert one.ldlj == pytest.approx(other.ldlj, abs=0.8)
        assert one.hand_to_tool_ms == pytest.approx(other.hand_to_tool_ms, abs=3.0)
        assert one.position_error_mm_rms == pytest.approx(other.position_error_mm_rms, rel=0.1)


def test_a_verdict_is_kept_beside_the_file_with_all_that_it_was_made_of(clean: Path, tmp_path: Path) -> None:
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


def test_a_file_that_is_no_recording_is_told_before_any_is_judged(clean: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.mcap").write_text("no recording")
    with pytest.raises(RecordingError, match=r"notes\.mcap: not an MCAP file"):
        next(judge_all([clean, tmp_path / "notes.mcap"]))
