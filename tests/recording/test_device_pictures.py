"""Pictures of a real camera are recorded with the time of their capture, with any plant, without delaying the loop."""

from __future__ import annotations

import io
import logging
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from q2r2_control.cameras.camera_process import CameraShot, DepthShot, png_of
from q2r2_control.cameras.camera_streams import CameraStreams
from q2r2_control.cameras.reasons import CameraReason
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.judging.camera_figures import camera_figures
from q2r2_control.judging.episode import read_episode
from q2r2_control.recording.about import About
from q2r2_control.recording.device_pictures import DevicePictures
from q2r2_control.recording.messages import PICTURE, STORE, depth_topic
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorder import ROOM_WITH_PICTURES, Recorder, RecordingSummary
from q2r2_control.recording.replay import replay
from q2r2_control.summary.tick import Tick
from tests.cameras.videos import FPS, HEIGHT, SLOW_FPS, WIDTH, number_of_jpeg, write_video
from tests.cli.command import q2r2
from tests.recording.runs import file_of, pipeline
from tests.support.processes import alive, wait_until

pytest.importorskip("cv2")

COUNT = 200  # Number of pictures in the video.
ENOUGH = 15  # A run ends after this number of pictures.


def front(path: Path, **changes: object) -> CameraConfig:
    values = {"device": str(path), "width": WIDTH, "height": HEIGHT, "rate": FPS, **changes}
    return CameraConfig.model_validate(values)


class RecordedRun:
    """A run in real time whose camera is a video file. It ends when ``during`` returns True."""

    def __init__(
        self,
        folder: Path,
        camera: CameraConfig,
        during: Callable[[RecordedRun], bool] | None = None,
        in_cell: CameraConfig | None = None,
    ) -> None:
        """Play the video of ``camera``. If ``in_cell`` is given, the cell has that camera instead."""
        self.loop = pipeline("circle", "kinematic", cameras={"front": in_cell or camera})
        self.shots: list[tuple[float, int]] = []  # The time of each capture [s], and the number in the picture.
        self.start = 0.0  # The time of the loop's clock at the start of the run [s].
        self.reports: list[ReasonKind] = []
        during = during or (lambda run: run.recorder.device_pictures >= ENOUGH)

        def stop(tick: Tick) -> None:
            self.start = tick.start.now
            if during(self):
                self.loop.stop()

        with (
            CameraStreams({"front": camera}) as self.streams,
            Recorder(folder, "test", room=ROOM_WITH_PICTURES) as self.recorder,
        ):
            self.streams.streams["front"].hear(self._note)
            self.streams.wait_until_ready()
            about = About.of(self.loop, True, {}, ("front",))
            self.recorder.begin(about, self.loop.robot)
            with DevicePictures(self.streams, True, self._report, (self.recorder, about)) as devices:
                self.loop.listeners += [self.recorder, devices, stop]
                self.loop.run(realtime=True)

    def _report(self, reason: Reason) -> None:
        self.reports.append(reason.kind)
        self.loop.record_outcome(reason)

    def _note(self, shot: CameraShot) -> None:
        self.shots.append((shot.time, number_of_jpeg(shot.jpeg)))

    @property
    def summary(self) -> RecordingSummary:
        return self.recorder.summary


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    folder = tmp_path_factory.mktemp("run")
    return RecordedRun(folder, front(write_video(folder / "front.avi", range(COUNT))))


def test_the_stamp_of_each_picture_is_the_time_of_its_capture_on_the_loops_clock(run: RecordedRun) -> None:
    recording = Recording(file_of(run.summary))
    pictures = list(recording.pictures("front"))
    assert len(pictures) == run.summary.pictures >= ENOUGH
    numbers = np.array([number_of_jpeg(picture.jpeg) for picture in pictures])
    stamps = np.array([picture.time - recording.about.epoch for picture in pictures]) * 1e-9
    steps = np.arange(len(numbers))
    np.testing.assert_array_equal(numbers, (numbers[0] + steps) % COUNT, "none is lost, and none comes twice")
    np.testing.assert_allclose(stamps - stamps[0], steps / FPS, atol=1e-6)
    captured = {round(time - run.start, 6): number for time, number in run.shots}
    assert [captured[round(stamp, 6)] for stamp in stamps.tolist()] == numbers.tolist()
    assert run.summary.lost_pictures == 0


def test_the_tick_of_a_picture_is_the_last_tick_before_its_capture(run: RecordedRun) -> None:
    recording = Recording(file_of(run.summary))
    ticks = np.concatenate([chunk.times for chunk in recording.chunks()])
    before, *pictures = recording.pictures("front")
    assert before.tick == 0
    assert before.time < ticks[0], "the first frame of a dataset has a picture"
    for picture in pictures:
        assert ticks[picture.tick] <= picture.time
        assert picture.tick + 1 == len(ticks) or picture.time < ticks[picture.tick + 1]


def test_the_judge_reads_pictures_of_a_real_camera_like_pictures_of_a_simulated_camera(run: RecordedRun) -> None:
    episode = read_episode(Recording(file_of(run.summary)))
    assert len(episode.pictures["front"].t) == run.summary.pictures
    assert 0 <= camera_figures(episode)["front"].missing_pictures <= 1
    assert not episode.pictures["front"].damaged.any()
    assert not episode.pictures["front"].other_size.any()


def test_a_camera_that_stops_is_reported_once_in_the_log_and_in_the_episode_and_the_run_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    after: list[int] = []

    def two_ticks_later(run: RecordedRun) -> bool:
        after.extend(len(run.reports) * [1])
        return len(after) > 2

    video = write_video(tmp_path / "short.avi", range(5))
    with caplog.at_level(logging.WARNING):
        done = RecordedRun(tmp_path, front(video, repeat=False), two_ticks_later)
    assert done.reports == [CameraReason.CAMERA_STOPPED]
    (line,) = [text for text in caplog.messages if text.startswith("camera front: no picture for ")]
    assert line.endswith(" s: the video has ended")
    assert done.summary.lost_pictures >= 20, "a second without pictures, at least"
    episode = read_episode(Recording(file_of(done.summary)))
    assert {event.kind for event in episode.events} >= {CameraReason.CAMERA_STOPPED}
    assert replay(file_of(done.summary)).difference is None, "the mark too"
    assert camera_figures(episode)["front"].missing_pictures == pytest.approx(done.summary.lost_pictures, abs=2)


def test_depth_is_recorded_and_exported_without_loss(tmp_path: Path) -> None:
    deep = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 21  # The values need all 16 bits.
    count = 0

    def with_depth(run: RecordedRun) -> bool:
        """Give depth with each picture, as the process of a RealSense camera does."""
        nonlocal count
        for time, _ in run.shots[count:]:
            run.streams.streams["front"]._on_answer(DepthShot(time, png_of(deep + np.uint16(count)), 1e-4))
            count += 1
        return run.recorder.device_pictures >= ENOUGH

    played = front(write_video(tmp_path / "front.avi", range(COUNT), fps=SLOW_FPS), rate=SLOW_FPS)
    in_cell = front(Path("realsense:042"), depth=True, rate=SLOW_FPS)
    done = RecordedRun(tmp_path / "recordings", played, with_depth, in_cell)
    recording = Recording(file_of(done.summary))
    assert recording.about.depth == ("front",)
    found = [message for messages in recording.messages((depth_topic("front"),)) for message in messages]
    assert len(found) >= ENOUGH // 2
    stamps = {picture.time for picture in recording.pictures("front")}
    for message in found:
        decoded: Any = STORE.deserialize_cdr(message.payload, PICTURE)
        assert decoded.format == "16UC1; png; unit 0.0001 m"
        pixels = np.asarray(Image.open(io.BytesIO(bytes(decoded.data))))
        np.testing.assert_array_equal(pixels - deep, pixels[0, 0])
        assert message.time in stamps, "it has the time of its capture"
    assert not read_episode(recording).pictures["front"].damaged.any()
    assert replay(recording.file).difference is None

    def told(name: str, *options: str) -> str:
        folder = str(tmp_path / name)
        return q2r2("export", name, str(recording.file), "--output", folder, "--keep-discarded", *options).stderr

    assert "depth of front is left out: csv has no place for it; allowed: hdf5, zarr\n" in told("csv")
    h5py = pytest.importorskip("h5py")
    assert "left out" not in told("hdf5", "--fps", "5")
    with h5py.File(tmp_path / "hdf5" / "episode_0.hdf5") as episode:
        data, pictures = episode["observations/depth/front"], episode["observations/images/front"]
        assert (data.dtype, data.attrs["unit"]) == (np.uint16, 1e-4)
        assert data.shape == pictures.shape[:3]
        np.testing.assert_array_equal(data[()] - deep, np.broadcast_to((data[()] - deep)[:, :1, :1], data.shape))
        assert len(np.unique(data[:, 0, 0])) > 1, "pictures follow each other"


def test_when_the_process_of_a_camera_is_killed_the_run_goes_on(tmp_path: Path) -> None:
    def killed(run: RecordedRun) -> bool:
        process = run.streams.streams["front"].process
        if run.recorder.device_pictures and alive(process.pid):
            os.kill(process.pid, signal.SIGKILL)
            wait_until(lambda: not process.alive)
        return CameraReason.CAMERA_STOPPED in run.reports

    done = RecordedRun(tmp_path, front(write_video(tmp_path / "front.avi", range(COUNT))), killed)
    assert done.streams.streams["front"].why_lost == "the process that reads camera front was ended by SIGKILL"
    assert done.summary.fault is None


def test_an_error_names_a_camera_that_cannot_be_opened_before_the_run_begins(tmp_path: Path) -> None:
    with (
        CameraStreams({"front": front(tmp_path / "none.avi")}) as streams,
        pytest.raises(CameraError, match=r"cameras\.front\.device: .*none\.avi: no such file"),
    ):
        streams.wait_until_ready()
