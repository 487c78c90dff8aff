"""A recorded run becomes the same episode with any number of processes, and each episode is made only once."""

from __future__ import annotations

import os
import platform
import shutil
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import ConfigError
from q2r2_control.export.episodes import EpisodeVectors, FrameSampling, Output, keep_episodes, make_episode
from q2r2_control.export.lerobot import source_of
from q2r2_control.process.places import Processes, chosen_place
from tests.export.files import CAMERA, HEIGHT, WIDTH, Run, contents, load_vectors, record_step, write_vectors
from tests.recording.runs import RATE, file_of, pipeline, record
from tests.support.pictures import needs_opengl

pytestmark = pytest.mark.slow

MOVED = 1e-4  # Smallest change that counts as a motion [m or rad].
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"  # These bytes begin the data of a chunk.


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return record_step(tmp_path_factory.mktemp("recordings"))


def first_moved(joints: npt.NDArray[np.floating]) -> int:
    """Return the index of the first row from which on all rows differ from the first row."""
    moved = np.abs(joints - joints[0]).max(axis=1) > MOVED
    first = int(np.argmax(moved))
    assert 0 < first < len(joints) - 10
    assert moved[first:].all()
    return first


def test_a_step_of_the_hand_appears_in_the_actions_and_observations_of_the_right_frames(run: Run) -> None:
    poses = {i: tick.targets["left"].pose for i, tick in enumerate(run.ticks)}
    asked = {i: pose.translation[1] for i, pose in poses.items() if pose is not None}
    engaged = min(asked)
    target = next(i for i, y in asked.items() if y > asked[engaged] + MOVED)
    command = first_moved(np.array([tick.reference.q for tick in run.ticks]))
    closing = next(i for i, tick in enumerate(run.ticks) if tick.command.grippers["left"] < 1.0)
    assert engaged < target <= command
    # At the loop's own rate, each tick is a frame. The joints of this plant are where the reference was a tick before.
    whole = make_episode(run.file, FrameSampling(fps=int(RATE)))
    y = whole.vectors["action.tool"][:, whole.names["action.tool"].index("left_y")]
    joints = [whole.names["action"].index(name) for name in whole.names["observation.velocity"]]
    assert engaged + int(np.argmax(y[engaged:] > y[engaged] + MOVED)) == target
    assert first_moved(whole.vectors["action"][:, joints]) == command
    assert first_moved(whole.vectors["observation.state"][:, joints]) == command + 1
    gripper = whole.vectors["action"][:, whole.names["action"].index("left_gripper")]
    assert int(np.argmax(gripper < 1.0)) == closing
    assert (whole.task, whole.cell, whole.recording) == ("a test", "dual_iiwa7", run.file.name)
    assert "version" in whole.notes
    assert np.flatnonzero(whole.outcome()["next.done"]).tolist() == [whole.frames - 1]
    # Ticks are 2 ms apart, so frame k is at the time of tick x = k / fps / 2 ms, which may lie between two ticks. The
    # frame has the command of tick i with i - 1 < x <= i, and the state of tick i with i <= x < i + 1.
    slow = make_episode(run.file, FrameSampling(fps=30))
    assert first_moved(slow.vectors["action"][:, joints]) == (command - 1) * 60 // 1000 + 1
    assert first_moved(slow.vectors["observation.state"][:, joints]) == -(-(command + 1) * 60 // 1000)


def test_an_episode_has_the_pictures_of_its_frames(tmp_path: Path) -> None:
    needs_opengl()
    camera = CameraConfig(position=(1.9, 0, 1), look_at=(0.4, 0, 0.3), width=WIDTH, height=HEIGHT, rate=20.0)
    file = file_of(record(tmp_path, pipeline("circle", "mujoco", cameras={CAMERA: camera}), 0.3))
    assert not make_episode(file, FrameSampling(20)).cameras
    episode = make_episode(file, FrameSampling(20, pictures=True))
    shown = list(episode.cameras[CAMERA])
    assert (len(shown), shown[0].shape) == (episode.frames, episode.cameras[CAMERA].size)


def test_position_actions_come_earlier_by_the_number_of_frames_in_the_option_ahead(run: Run) -> None:
    plain, ahead = (make_episode(run.file, FrameSampling(fps=30, ahead=frames)) for frames in (0, 2))
    assert (plain.ahead, ahead.ahead, ahead.frames) == (0, 2, plain.frames)
    for name, rows in plain.vectors.items():
        moved = name in ("action", "action.tool")
        expected = np.concatenate((rows[2:], rows[-1:], rows[-1:])) if moved else rows
        np.testing.assert_array_equal(ahead.vectors[name], expected, err_msg=name)
    assert "action_ahead_frames" not in source_of(plain)
    assert source_of(ahead)["action_ahead_frames"] == 2
    for wrong in (-1, 31):
        with pytest.raises(ConfigError, match=rf"--ahead {wrong}: allowed: 0 \.\. 30"):
            FrameSampling(fps=30, ahead=wrong)


@pytest.mark.parametrize("fps", [0, -30, 1001])
def test_an_impossible_rate_is_refused(fps: int) -> None:
    with pytest.raises(ConfigError, match=rf"--fps {fps}: allowed: 1 \.\. 1000"):
        FrameSampling(fps=fps)


def test_an_export_that_goes_on_after_an_interruption_keeps_its_finished_episodes(run: Run, tmp_path: Path) -> None:
    files = [run.file, Path(shutil.copy(run.file, tmp_path / "copy.mcap"))]
    kept = tmp_path / "kept"
    kept.mkdir()

    def interrupt(done: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        keep_episodes(files, FrameSampling(), write_vectors, kept, progress=interrupt)
    (first,) = kept.iterdir()
    made_at = first.stat().st_mtime_ns
    made = keep_episodes(files, FrameSampling(), write_vectors, kept)
    assert made.kept[0] == first
    assert first.stat().st_mtime_ns == made_at
    # An unfinished episode is made again, and so is an episode with other options.
    first.rename(first.with_name(f"{first.name}.unfinished"))
    keep_episodes(files, FrameSampling(), write_vectors, kept)
    assert load_vectors(first).frames == load_vectors(made.kept[1]).frames
    other = keep_episodes(files[:1], FrameSampling(fps=10), write_vectors, kept)
    assert load_vectors(other.kept[0]).fps == 10


def write_at_open_gate(episode: EpisodeVectors, path: Path) -> None:
    """Write an episode. If a pipe named ``gate`` is beside the folder, first wait until a process reads the pipe."""
    if (gate := path.parent.with_name("gate")).exists():
        gate.write_bytes(b"")
    write_vectors(episode, path)


def test_a_killed_worker_raises_an_error_of_one_line_and_the_next_export_goes_on(run: Run, tmp_path: Path) -> None:
    files = [run.file, *(Path(shutil.copy(run.file, tmp_path / f"copy-{number}.mcap")) for number in range(2))]
    kept = tmp_path / "kept"
    kept.mkdir()
    *others, last = keep_episodes(files, FrameSampling(), write_at_open_gate, kept).kept
    by_one_process = contents(kept)
    last.unlink()
    made_at = [other.stat().st_mtime_ns for other in others]
    gate = tmp_path / "gate"
    os.mkfifo(gate)  # No process reads this pipe, so a worker stays in the middle of its episode.

    def kill(done: int) -> None:
        if done == len(others):
            for process in active_children():
                process.kill()

    with pytest.raises(ConfigError, match="a process that did the work was killed") as fault:
        keep_episodes(files, FrameSampling(), write_at_open_gate, kept, place=Processes(2), progress=kill)
    assert "\n" not in str(fault.value)
    gate.unlink()
    assert keep_episodes(files, FrameSampling(), write_at_open_gate, kept, place=Processes(2)).kept == [*others, last]
    assert [other.stat().st_mtime_ns for other in others] == made_at
    assert contents(kept) == by_one_process


def test_an_anonymous_episode_names_no_operator_and_no_computer(run: Run) -> None:
    named, anonymous = (make_episode(run.file, FrameSampling(anonymous=leaves)).notes for leaves in (False, True))
    assert named["machine"] == f"{platform.node()}, {anonymous['machine']}"
    assert anonymous.keys() == named.keys() - {"operator"}


def by_name(file: Path, pictures: bool) -> dict[int, str]:
    return {0: "discard: by its name"} if "copy" in file.stem else {}


@pytest.mark.parametrize("workers", [1, 2])
def test_bad_recordings_and_discarded_recordings_are_named_and_all_other_recordings_are_kept(
    workers: int, run: Run, tmp_path: Path
) -> None:
    damaged, copy = tmp_path / "damaged.mcap", Path(shutil.copy(run.file, tmp_path / "copy.mcap"))
    data = bytearray(run.file.read_bytes())
    data[data.index(ZSTD_MAGIC) + 200] ^= 0xFF
    damaged.write_bytes(data)
    (tmp_path / "empty.mcap").touch()
    files = [damaged, copy, tmp_path / "empty.mcap", run.file]
    made = keep_episodes(
        files, FrameSampling(), write_vectors, tmp_path, place=chosen_place(workers, None), verdicts=by_name
    )
    assert [kept.stem for kept in made.kept] == [run.file.stem]
    assert made.left_out == [f"{copy}: discard: by its name"]
    assert [line.partition(": ")[0] for line in made.unreadable] == [str(damaged), str(tmp_path / "empty.mcap")]
    assert made.unreadable[0].startswith(f"{damaged}: discard: unreadable, damaged: ")
    assert len(keep_episodes(files, FrameSampling(), write_vectors, tmp_path).kept) == 2


def test_an_output_that_exists_or_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(ConfigError, match="there: exists; allowed: a name that does not exist yet"):
        Output(tmp_path / "there")
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"--output .*file/made: Not a directory"):
        Output(tmp_path / "file" / "made").episodes()
    late = Output(tmp_path / "late")
    late.episodes()

    def meanwhile(target: Path) -> None:
        target.mkdir()
        shutil.copytree(tmp_path / "there", tmp_path / "late")

    with pytest.raises(ConfigError, match="late: exists"):
        late.write(meanwhile)
