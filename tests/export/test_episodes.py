"""A recorded run becomes the episode that was lived."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import ConfigError
from q2r2_control.export.episodes import FrameSampling, make_episode
from tests.export.runs import Run, record_step
from tests.export.vectors import CAMERA, HEIGHT, WIDTH
from tests.recording.runs import RATE, file_of, pipeline, record
from tests.support.pictures import needs_opengl

pytestmark = pytest.mark.slow

MOVED = 1e-4  # [m] and [rad]


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
    assert np.flatnonzero(episode.outcome()["next.done"]).tolist() == [episode.frames - 1]


def test_an_episode_has_the_pictures_of_its_frames(tmp_path: Path) -> None:
    needs_opengl()
    camera = CameraConfig(position=(1.9, 0, 1), look_at=(0.4, 0, 0.3), width=WIDTH, height=HEIGHT, rate=20.0)
    file = file_of(record(tmp_path, pipeline("circle", "mujoco", cameras={CAMERA: camera}), 0.3))
    assert not make_episode(file, FrameSampling(20)).cameras
    episode = make_episode(file, FrameSampling(20, pictures=True))
    shown = list(episode.cameras[CAMERA])
    assert (len(shown), shown[0].shape) == (episode.frames, episode.cameras[CAMERA].size)


@pytest.mark.parametrize("fps", [0, -30, 1001])
def test_a_rate_that_no_recording_has_is_refused(fps: int) -> None:
    with pytest.raises(ConfigError, match=rf"--fps {fps}: allowed: 1 \.\. 1000"):
        FrameSampling(fps=fps)
