"""A process beside the loop takes and records pictures.

In simulated time, each picture is exactly on time. In real time, pictures never delay the loop, and lost
pictures are counted.
"""

from __future__ import annotations

import io
import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from q2r2_control.config.recording import CameraConfig
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.recording.camera_recorder import CameraRecorder
from q2r2_control.recording.reader import Picture, Recording
from q2r2_control.recording.recorder import Recorder
from q2r2_control.recording.replay import replay
from q2r2_control.summary.tick import Tick
from tests.recording.runs import RATE, file_of, pipeline, read_elsewhere, record
from tests.recording.test_writer_process import file_in, script
from tests.support.pictures import needs_opengl
from tests.support.processes import alive, wait_until

pytestmark = pytest.mark.slow

FRONT = CameraConfig(position=(1.9, 0.0, 1.0), look_at=(0.4, 0.0, 0.3), width=64, height=48, rate=20.0)
HAND = CameraConfig(
    link="left_hand_e_base", position=(0.1, 0.0, 0.0), rpy=(0.0, -1.57, 0.0), width=32, height=32, rate=8.0
)
DURATION = 0.3  # [s]
NO_MORE = "no more pictures are recorded, the run goes on: "


def loop_with(**cameras: CameraConfig) -> Pipeline:
    return pipeline("circle", "mujoco", cameras=cameras)


def cameras_of(recorder: Recorder) -> CameraRecorder:
    assert recorder.cameras is not None
    return recorder.cameras


def pixels(picture: Picture) -> npt.NDArray[np.int64]:
    return np.asarray(Image.open(io.BytesIO(picture.jpeg)), dtype=np.int64)


def test_in_simulated_time_there_is_a_picture_at_each_multiple_of_a_cameras_period(tmp_path: Path) -> None:
    needs_opengl()
    loop = loop_with(front=FRONT, hand=HAND)
    plant, times = loop.plant, list[float]()
    assert isinstance(plant, MujocoPlant)
    places = [plant.model.joint(name).qposadr[0] for name in loop.robot.joint_names]

    def observe(tick: Tick) -> None:
        """Store the tick's time. Check that the joint positions for pictures are the positions in the tick's state."""
        np.testing.assert_array_equal(plant.observed_qpos[places], tick.state.q)
        times.append(tick.t)

    loop.listeners.append(observe)
    summary = record(tmp_path, loop, DURATION)
    assert (summary.pictures_fault, summary.lost_pictures) == (None, 0)
    recording = Recording(file := file_of(summary))
    for name, camera in loop.config.cameras.items():
        pictures = list(recording.pictures(name))
        due = np.arange(len(pictures)) / camera.rate
        first = [next(at for at, t in enumerate(times) if t >= time - 1e-9) for time in due]
        assert [picture.tick for picture in pictures] == first
        assert len(pictures) == int(times[-1] * camera.rate + 1e-6) + 1
        stamps = [(picture.time - recording.about.epoch) * 1e-9 for picture in pictures]
        assert stamps == pytest.approx([times[at] for at in first], abs=1e-9)
        assert {pixels(picture).shape for picture in pictures} == {(camera.height, camera.width, 3)}
    found = read_elsewhere(file.parent, tmp_path)
    assert found["/front/image/compressed"]["type"] == "sensor_msgs/msg/CompressedImage"
    assert sum(found[f"/{name}/image/compressed"]["count"] for name in loop.config.cameras) == summary.pictures
    assert replay(file).difference is None


def test_a_picture_shows_a_moved_object_at_its_new_position(tmp_path: Path) -> None:
    needs_opengl()
    loop = loop_with(front=FRONT)
    plant = loop.plant
    assert isinstance(plant, MujocoPlant)

    def moves_a_block(tick: Tick) -> None:
        # Half of the run is so long that MuJoCo no longer simulates the resting block (it sleeps).
        if tick.t >= 0.5 * DURATION:
            plant.data.joint("blue_block_free").qpos[:3] = (0.4, 0.0, 0.7)

    loop.listeners.append(moves_a_block)
    first, *_, last = list(Recording(file_of(record(tmp_path, loop, DURATION))).pictures("front"))
    moved = np.abs(pixels(last) - pixels(first)).max(axis=2) > 60
    rows, columns = np.nonzero(moved)
    assert moved.any()
    assert rows.min() < 24 < rows.max(), "gone from the table, and in the air"
    assert columns.max() < 60


@pytest.mark.soak
def test_pictures_that_are_not_taken_in_time_are_lost_and_counted(tmp_path: Path) -> None:
    needs_opengl()
    taken: list[int] = []

    def stopped_for_a_while(recorder: Recorder) -> Iterator[None]:
        pid = cameras_of(recorder).process.pid
        os.kill(pid, signal.SIGSTOP)
        while cameras_of(recorder).due < 600:  # 600 pictures do not fit into the queue.
            yield
        os.kill(pid, signal.SIGCONT)
        taken.append(cameras_of(recorder).due)

    loop = loop_with(front=FRONT.model_copy(update={"rate": 240.0}))
    summary = record(tmp_path, loop, 4.0, waits=False, during=script(loop, stopped_for_a_while))
    assert (summary.fault, summary.pictures_fault, summary.lost_ticks) == (None, None, 0)
    assert summary.lost_pictures > 50
    assert summary.pictures > 100
    assert summary.pictures + summary.lost_pictures >= taken[0]
    assert len(list(Recording(file_in(tmp_path)).pictures("front"))) == summary.pictures


def test_if_the_process_that_takes_pictures_is_killed_the_recording_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    needs_opengl()

    def killed(recorder: Recorder) -> Iterator[None]:
        while cameras_of(recorder).due < 4:
            yield
        wait_until(lambda: recorder.written.messages)
        os.kill(cameras_of(recorder).process.pid, signal.SIGSTOP)
        due = cameras_of(recorder).due
        while cameras_of(recorder).due == due:
            yield
        os.kill(cameras_of(recorder).process.pid, signal.SIGKILL)
        wait_until(lambda: not alive(cameras_of(recorder).process.pid))
        while not caplog.records:
            yield

    loop = loop_with(front=FRONT)
    with caplog.at_level(logging.WARNING):
        summary = record(tmp_path, loop, 60.0, during=script(loop, killed))
    assert caplog.messages == [f"{NO_MORE}{summary.pictures_fault}"]
    assert summary.pictures_fault == "the process that takes pictures was ended by SIGKILL"
    assert summary.lost_pictures > 0
    assert replay(file_of(summary)).difference is None


def test_without_opengl_one_line_says_so_and_the_run_is_recorded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", str(tmp_path / "none"))
    with caplog.at_level(logging.WARNING):
        summary = record(tmp_path, loop_with(front=FRONT), 0.1)
    (line,) = caplog.messages
    assert line.startswith(f"{NO_MORE}no pictures: ")
    assert "allowed: MUJOCO_GL=egl" in line
    assert summary.pictures == 0 < summary.lost_pictures
    assert summary.ticks >= 0.1 * RATE
    assert file_of(summary).exists()
