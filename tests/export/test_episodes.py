"""A recorded run becomes the episode that was lived, once, by however many processes."""

from __future__ import annotations

import os
import shutil
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.episodes import EpisodeVectors, FrameSampling, make_episode, make_episodes
from tests.export.runs import Run, contents, record_step
from tests.recording.runs import RATE

pytestmark = pytest.mark.slow

MOVED = 1e-4  # [m] and [rad]
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # begins the data of a chunk


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return record_step(tmp_path_factory.mktemp("recordings"))


def first_moved(joints: npt.NDArray[np.floating]) -> int:
    """Index of the first row that is away from the first row, from which on all are."""
    moved = np.abs(joints - joints[0]).max(axis=1) > MOVED
    first = int(np.argmax(moved))
    assert 0 < first < len(joints) - 10
    assert moved[first:].all()
    return first


def test_a_step_of_the_hand_is_in_action_and_observation_at_the_stated_frames(run: Run) -> None:
    poses = {i: tick.targets["left"].pose for i, tick in enumerate(run.ticks)}
    asked = {i: pose.translation[1] for i, pose in poses.items() if pose is not None}
    engaged = min(asked)
    target = next(i for i, y in asked.items() if y > asked[engaged] + MOVED)
    command = first_moved(np.array([tick.reference.q for tick in run.ticks]))
    closing = next(i for i, tick in enumerate(run.ticks) if tick.command.grippers["left"] < 1.0)
    assert engaged < target <= command
    # At the loop's own rate each tick is a frame, and this plant is where the reference was a tick before.
    whole = make_episode(run.file, FrameSampling(fps=int(RATE)))
    y = whole.vectors["action.tool"][:, whole.names["action.tool"].index("left_y")]
    joints = [whole.names["action"].index(name) for name in whole.names["observation.velocity"]]
    assert engaged + int(np.argmax(y[engaged:] > y[engaged] + MOVED)) == target
    assert first_moved(whole.vectors["action"][:, joints]) == command
    assert first_moved(whole.vectors["observation.state"][:, joints]) == command + 1
    gripper = whole.vectors["action"][:, whole.names["action"].index("left_gripper")]
    assert int(np.argmax(gripper < 1.0)) == closing
    # Ticks are 2 ms apart: frame k is that of command i where i - 1 < k / fps / 2 ms <= i, of state i where it is in
    # i <= ... < i + 1.
    slow = make_episode(run.file, FrameSampling(fps=30))
    assert first_moved(slow.vectors["action"][:, joints]) == (command - 1) * 60 // 1000 + 1
    assert first_moved(slow.vectors["observation.state"][:, joints]) == -(-(command + 1) * 60 // 1000)


def test_measured_tools_are_those_that_the_loop_measured(run: Run) -> None:
    episode = make_episode(run.file, FrameSampling(fps=int(RATE)))
    for arm in ("left", "right"):
        at = [episode.names["observation.tool"].index(f"{arm}_{axis}") for axis in "xyz"]
        lived = [tick.tools[arm].translation for tick in run.ticks]
        np.testing.assert_allclose(episode.vectors["observation.tool"][:, at], lived, atol=1e-6)


def test_an_episode_knows_its_task_its_cell_and_its_last_frame(run: Run) -> None:
    episode = make_episode(run.file, FrameSampling(fps=50))
    assert (episode.task, episode.cell, episode.recording) == ("a test", "dual_iiwa7", run.file.name)
    assert "version" in episode.notes
    columns = episode.columns(index=3, first_frame=100, task=2)
    assert np.flatnonzero(columns["next.done"]).tolist() == [episode.frames - 1]
    np.testing.assert_array_equal(columns["timestamp"], np.float32(np.arange(episode.frames) / 50))
    assert columns["index"].tolist() == list(range(100, 100 + episode.frames))
    assert set(columns["episode_index"]) == {3}
    assert set(columns["task_index"]) == {2}


def test_an_episode_that_was_kept_is_the_same(run: Run, tmp_path: Path) -> None:
    episode = make_episode(run.file, FrameSampling())
    episode.save(tmp_path / "kept.npz")
    again = EpisodeVectors.load(tmp_path / "kept.npz")
    assert again.names == episode.names
    for name, values in episode.vectors.items():
        np.testing.assert_array_equal(again.vectors[name], values)
    assert [again.recording, again.cell, again.task, again.fps, again.notes] == [
        *(episode.recording, episode.cell, episode.task, episode.fps, episode.notes)
    ]


def test_several_processes_make_the_same_bytes_as_one(run: Run, tmp_path: Path) -> None:
    files = [run.file, Path(shutil.copy(run.file, tmp_path / "copy.mcap"))]
    for workers in (1, 2):
        (tmp_path / str(workers)).mkdir()
        made = make_episodes(files, FrameSampling(), tmp_path / str(workers), workers=workers)
        assert len(made.kept) == 2
        assert [EpisodeVectors.load(file).recording for file in made.kept] == [file.name for file in files]
    assert contents(tmp_path / "1") == contents(tmp_path / "2") != {}


def test_an_interrupted_export_goes_on_with_what_it_had(run: Run, tmp_path: Path) -> None:
    files = [run.file, Path(shutil.copy(run.file, tmp_path / "copy.mcap"))]
    kept = tmp_path / "kept"
    kept.mkdir()

    def interrupt(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_episodes(files, FrameSampling(), kept, progress=interrupt)
    (first,) = kept.iterdir()
    made_at = first.stat().st_mtime_ns
    made = make_episodes(files, FrameSampling(), kept)
    assert made.kept[0] == first
    assert first.stat().st_mtime_ns == made_at
    # Half of a file, as a machine without power may leave it, and other options, are made anew.
    first.write_bytes(first.read_bytes()[:1000])
    make_episodes(files, FrameSampling(), kept)
    assert EpisodeVectors.load(first).frames == EpisodeVectors.load(made.kept[1]).frames
    other = make_episodes(files[:1], FrameSampling(fps=10), kept)
    assert EpisodeVectors.load(other.kept[0]).fps == 10


def test_a_worker_that_is_killed_is_one_line_and_the_next_export_goes_on(run: Run, tmp_path: Path) -> None:
    files = [run.file, *(Path(shutil.copy(run.file, tmp_path / f"copy-{number}.mcap")) for number in range(2))]
    kept = tmp_path / "kept"
    kept.mkdir()
    *others, last = make_episodes(files, FrameSampling(), kept).kept
    last.unlink()
    made_at = [other.stat().st_mtime_ns for other in others]
    os.mkfifo(last.with_suffix(".unfinished"))  # nobody reads it, so a worker is in the middle of its episode for good

    def kill(done: int) -> None:
        if done == len(others):
            for process in active_children():
                process.kill()

    with pytest.raises(ConfigError, match="a process of --workers was killed") as fault:
        make_episodes(files, FrameSampling(), kept, workers=2, progress=kill)
    assert "\n" not in str(fault.value)
    last.with_suffix(".unfinished").unlink()
    assert make_episodes(files, FrameSampling(), kept, workers=2).kept == [*others, last]
    assert [other.stat().st_mtime_ns for other in others] == made_at


@pytest.mark.parametrize("workers", [1, 2])
def test_a_bad_recording_is_named_or_skipped(workers: int, run: Run, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.mcap"
    data = bytearray(run.file.read_bytes())
    data[data.rindex(ZSTD_MAGIC) + 200] ^= 0xFF
    damaged.write_bytes(data)
    with pytest.raises(RecordingError, match=r"damaged\.mcap: damaged"):
        make_episodes([damaged, run.file], FrameSampling(), tmp_path, workers=workers)
    made = make_episodes([damaged, run.file], FrameSampling(), tmp_path, workers=workers, skip_bad=True)
    assert len(made.kept) == 1
    (fault,) = made.skipped
    assert "damaged.mcap: damaged" in fault


@pytest.mark.parametrize("fps", [0, -30, 1001])
def test_a_rate_that_no_recording_has_is_refused(fps: int) -> None:
    with pytest.raises(ConfigError, match=rf"--fps {fps}: allowed: 1 \.\. 1000"):
        FrameSampling(fps=fps)
