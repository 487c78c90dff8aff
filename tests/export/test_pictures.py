"""A frame has the newest picture that was taken at or before it, and none that is too old."""

from __future__ import annotations

from pathlib import Path

import pytest

from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import RecordingError
from q2r2_control.export.sampling import CameraFrames
from q2r2_control.recording.reader import Recording
from tests.export.files import EPOCH, brightness, write_recording

pytestmark = pytest.mark.slow

MS = 1_000_000  # [ns]
CAMERA = CameraConfig(position=(1, 0, 1), rpy=(0, 0, 0), width=16, height=16, rate=50.0)
TICKS = [MS * t for t in range(1, 200)]


def shown(path: Path, taken: list[int], frames: list[int]) -> list[int]:
    """The brightness of the picture of each frame; all times in [ms] since the start."""
    pictures = {"front": [MS * time for time in taken]}
    file = write_recording(path / "a.mcap", TICKS, cameras={"front": CAMERA}, pictures=pictures)
    stamps = [EPOCH + MS * time for time in frames]
    return [round(float(pixels.mean())) for pixels in CameraFrames(Recording(file), "front", CAMERA, stamps)]


def test_a_frame_has_the_newest_picture_at_or_before_it(tmp_path: Path) -> None:
    found = shown(tmp_path, [1, 20, 40, 60, 80], [1, 19, 20, 21, 59, 60, 85, 120])
    assert found == [brightness(number) for number in (0, 0, 1, 1, 2, 3, 4, 4)]


@pytest.mark.parametrize(
    ("taken", "frames", "what"),
    [
        pytest.param([1, 20], [1, 60, 61], r"a picture 0\.041 s old at 0\.061 s", id="lost for more than two periods"),
        pytest.param([5], [4], r"no picture yet at 0\.004 s", id="taken later"),
        pytest.param([], [4], r"no picture yet at 0\.004 s", id="never taken"),
    ],
)
def test_a_frame_without_a_picture_of_its_time_is_refused(
    tmp_path: Path, taken: list[int], frames: list[int], what: str
) -> None:
    with pytest.raises(RecordingError, match=rf"a\.mcap: camera front has {what}; allowed: at most two of its periods"):
        shown(tmp_path, taken, frames)


def test_a_picture_of_another_size_is_damage(tmp_path: Path) -> None:
    file = write_recording(tmp_path / "a.mcap", TICKS, cameras={"front": CAMERA}, pictures={"front": [MS]})
    larger = CAMERA.model_copy(update={"width": 32})
    with pytest.raises(RecordingError, match=r"a\.mcap: damaged: a picture of camera front has a size"):
        next(iter(CameraFrames(Recording(file), "front", larger, [EPOCH + MS])))
