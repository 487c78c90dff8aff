"""Videos have a picture for each frame, at its time, one episode behind the other."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.config.cameras import CameraConfig
from q2r2_control.errors import RecordingError
from q2r2_control.export import video
from q2r2_control.export.episodes import EpisodeVectors, FrameSampling, make_episodes
from q2r2_control.export.kept_pictures import KeptAs
from q2r2_control.export.lerobot import write_dataset
from q2r2_control.export.statistics import QUANTILES, statistics_of
from q2r2_control.export.video import PixelStatistics
from tests.export.runs import contents
from tests.export.test_lerobot import EPISODES
from tests.export.videos import CAMERA, HEIGHT, WIDTH, save_with_videos
from tests.recording.runs import file_of, pipeline, record
from tests.support.pictures import needs_opengl

pytestmark = pytest.mark.slow

av = pytest.importorskip("av", reason="the extra export is not installed")
pyarrow = pytest.importorskip("pyarrow.parquet", reason="the extra export is not installed")

KEY = f"observation.images.{CAMERA}"


def rows_of(folder: Path) -> list[dict[str, object]]:
    rows: list[dict[str, object]] = pyarrow.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    return rows


def test_a_dataset_has_all_pictures_of_all_episodes_at_their_times(tmp_path: Path) -> None:
    files, pictures = save_with_videos(EPISODES, tmp_path)
    write_dataset(files, tmp_path / "made")
    with av.open(str(tmp_path / "made" / "videos" / KEY / "chunk-000" / "file-000.mp4")) as container:
        assert container.streams.video[0].average_rate == 30, "by which loaders find pictures"
        decoded = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in container.decode(video=0)]
    expected = [pixels for episode in pictures for pixels in episode]
    assert [time for time, _ in decoded] == pytest.approx([frame / 30 for frame in range(len(expected))], abs=1e-6)
    for (_, found), pixels in zip(decoded, expected, strict=True):
        assert np.abs(found.astype(float) - pixels).mean() < 6
    spans = [
        (row[f"videos/{KEY}/from_timestamp"], row[f"videos/{KEY}/to_timestamp"]) for row in rows_of(tmp_path / "made")
    ]
    assert spans == [(0.0, 40 / 30), (40 / 30, 65 / 30), (65 / 30, 125 / 30)]
    info = json.loads((tmp_path / "made" / "meta" / "info.json").read_text())
    assert info["features"][KEY]["shape"] == [HEIGHT, WIDTH, 3]
    assert info["video_path"].format(video_key=KEY, chunk_index=0, file_index=0) == (
        f"videos/{KEY}/chunk-000/file-000.mp4"
    )


def test_an_episode_that_does_not_fit_begins_a_new_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "FILE_SIZE", 0)
    files, pictures = save_with_videos(EPISODES, tmp_path)
    write_dataset(files, tmp_path / "made")
    for number, (row, shown) in enumerate(zip(rows_of(tmp_path / "made"), pictures, strict=True)):
        assert (row[f"videos/{KEY}/chunk_index"], row[f"videos/{KEY}/file_index"]) == (0, number)
        assert row[f"videos/{KEY}/from_timestamp"] == 0.0
        with av.open(str(tmp_path / "made" / "videos" / KEY / f"chunk-000/file-{number:03d}.mp4")) as container:
            assert len(list(container.decode(video=0))) == len(shown)


def test_the_same_pictures_give_the_same_bytes(tmp_path: Path) -> None:
    made = []
    for folder in (tmp_path / "one", tmp_path / "two"):
        folder.mkdir()
        files, _ = save_with_videos(EPISODES[:2], folder)
        write_dataset(files, folder / "made")
        made.append({file.name: file.read_bytes() for file in (folder / "made").rglob("*.mp4")})
    assert made[0] == made[1]


def test_an_episode_without_the_cameras_of_the_others_is_refused(tmp_path: Path) -> None:
    files, _ = save_with_videos(EPISODES[:1], tmp_path)
    without: EpisodeVectors = EPISODES[1]
    without.save(tmp_path / "without.npz")
    with pytest.raises(RecordingError, match=r"run-2\.mcap: has not the cameras that run-1\.mcap has"):
        write_dataset([*files, tmp_path / "without.npz"], tmp_path / "made")


def test_recorded_pictures_become_the_same_dataset_with_any_number_of_workers(tmp_path: Path) -> None:
    needs_opengl()
    camera = CameraConfig(position=(1.9, 0, 1), look_at=(0.4, 0, 0.3), width=WIDTH, height=HEIGHT, rate=20.0)
    made = []
    runs = [pipeline("circle", "mujoco", cameras={CAMERA: camera}) for _ in range(2)]
    files = [file_of(record(tmp_path / "recordings", run, 0.3)) for run in runs]
    for workers in (1, 2):
        (kept := tmp_path / f"kept-{workers}").mkdir()
        episodes = make_episodes(files, FrameSampling(20, pictures=KeptAs.VIDEO), kept, workers=workers).kept
        write_dataset(episodes, tmp_path / str(workers))
        made.append(contents(tmp_path / str(workers)))
    assert made[0] == made[1]
    first = EpisodeVectors.load(episodes[0])
    with av.open(str(tmp_path / "1" / "videos" / KEY / "chunk-000" / "file-000.mp4")) as container:
        shown = [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)]
    assert len(shown) == 2 * first.frames
    for found, again in zip(shown[: first.frames], shown[first.frames :], strict=True):
        assert np.abs(found - again).mean() < 2, "the second run was the same"


def test_statistics_of_colours_are_those_of_their_pixels() -> None:
    pictures = np.random.default_rng(1).integers(0, 256, (5, 20, 30, 3), dtype=np.uint8)
    counted = PixelStatistics()
    for pixels in pictures:
        counted.add(pixels)
    found, expected = counted.result(), statistics_of(pictures.reshape(-1, 3) / 255.0)
    for name in ("min", "max", "mean", "std", *QUANTILES):
        np.testing.assert_allclose(found[name], expected[name], atol=1e-12)
    assert found["count"].tolist() == [5]
