"""Frames are evenly spaced; observations are the newest that were known, commands the first that followed."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.errors import RecordingError
from q2r2_control.export.sampling import sample
from q2r2_control.recording.reader import Recording
from tests.export.files import write_recording

pytestmark = pytest.mark.slow

MS = 1_000_000


def uneven(count: int) -> list[int]:
    """Times of ticks about a millisecond apart, with one that was 70 ms late."""
    random = np.random.default_rng(0)
    steps = random.integers(MS // 2, 3 * MS // 2, count)
    steps[count // 2] += 70 * MS
    return [int(time) for time in np.cumsum(steps)]


@pytest.mark.parametrize("fps", [1, 24, 30, 60, 200, 1000])
def test_observations_are_of_the_newest_tick_and_commands_of_the_first_that_is_not_before(
    fps: int, tmp_path: Path
) -> None:
    times = uneven(1500)
    frames = sample(Recording(write_recording(tmp_path / "a.mcap", times)), fps)
    k = 0
    while (due := times[0] + round(Fraction(k * 10**9, fps))) <= times[-1]:
        newest = max(place for place, time in enumerate(times) if time <= due)
        first = min(place for place, time in enumerate(times) if time >= due)
        assert frames["position"][k, 3] == -newest
        assert frames["velocity"][k, 3] == -10 * newest
        assert frames["effort"][k, 3] == -100 * newest
        assert frames["reference"][k, 3] == first
        assert frames["target"][k, 1, 0] == first
        k += 1
    assert {len(values) for values in frames.values()} == {k}


def test_a_tick_at_the_time_of_a_frame_gives_both(tmp_path: Path) -> None:
    times = [10 * MS * place for place in range(40)]
    frames = sample(Recording(write_recording(tmp_path / "a.mcap", times)), fps=50)
    assert frames["reference"][:, 0].tolist() == [2 * k for k in range(20)]
    assert frames["position"][:, 0].tolist() == [-2 * k for k in range(20)]
    assert frames["time"] == pytest.approx([k / 50 for k in range(20)], abs=0.0)


def test_the_target_is_the_operators_while_there_is_one_and_the_reference_else(tmp_path: Path) -> None:
    times = [MS * place for place in range(30)]
    file = write_recording(tmp_path / "a.mcap", times, engaged=range(5, 20))
    frames = sample(Recording(file), fps=1000)
    assert frames["target"][:, 0, 0].tolist() == [k + 1000 if 5 <= k < 20 else k for k in range(30)]
    assert frames["target"][:, 1, 0].tolist() == list(range(30))


@pytest.mark.parametrize(
    ("engaged", "moving", "first", "last"),
    [
        pytest.param(range(12, 31), (), 12, 30, id="engaged"),
        pytest.param((), range(9, 22), 9, 21, id="moving"),
        pytest.param(range(12, 15), range(40, 43), 12, 42, id="with a pause in between"),
    ],
)
def test_trimmed_frames_begin_and_end_where_an_arm_is_engaged_or_moves(
    engaged: range, moving: range, first: int, last: int, tmp_path: Path
) -> None:
    times = [MS * place for place in range(60)]
    recording = Recording(write_recording(tmp_path / "a.mcap", times, engaged=engaged, moving=moving))
    frames = sample(recording, fps=500, trim=True)
    assert frames["reference"][:, 0].tolist() == list(range(first, last + 1, 2))
    assert frames["time"][0] == 0.0
    assert len(sample(recording, fps=500)["time"]) == 30


def test_nothing_to_trim_to_is_an_error(tmp_path: Path) -> None:
    file = write_recording(tmp_path / "still.mcap", [0, MS, 2 * MS])
    with pytest.raises(RecordingError, match=r"still\.mcap: no arm was ever engaged"):
        sample(Recording(file), fps=30, trim=True)


def test_ticks_that_were_lost_for_longer_than_a_frame_are_an_error(tmp_path: Path) -> None:
    numbers = [*range(20), *range(45, 65)]
    file = write_recording(tmp_path / "lossy.mcap", [MS * number for number in numbers], numbers=numbers)
    assert len(sample(Recording(file), fps=30)["time"]) == 2
    with pytest.raises(RecordingError, match=r"lossy\.mcap: 25 ticks were lost after 0\.019 s"):
        sample(Recording(file), fps=60)


@pytest.mark.parametrize("times", [(0, 2 * MS, MS), (5 * MS, 4 * MS)], ids=["later", "at once"])
def test_times_that_go_back_are_an_error(times: tuple[int, ...], tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"a\.mcap: damaged: ticks are not in the order of time"):
        sample(Recording(write_recording(tmp_path / "a.mcap", times)), fps=30)


def test_a_recording_without_a_tick_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"a\.mcap: no tick was recorded"):
        sample(Recording(write_recording(tmp_path / "a.mcap", [])), fps=30)


def test_openings_are_of_the_arms_they_are_named_by(tmp_path: Path) -> None:
    times = [MS * place for place in range(3)]
    openings = {"wanted": (0.1, 0.4), "commanded": (0.2, 0.5), "opening": (0.3, 0.6)}
    frames = sample(Recording(write_recording(tmp_path / "a.mcap", times, openings=openings)), fps=1000)
    assert frames["gripper"].tolist() == [[0.2, 0.5]] * 3
    assert frames["opening"].tolist() == [[0.3, 0.6]] * 3
