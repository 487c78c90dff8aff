"""A video file plays as a camera: each picture has the time at which the file shows it, however late it is read."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.cameras.opening import open_device
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError
from tests.cameras.videos import FPS, HEIGHT, WIDTH, number_in, numbered, write_video

pytest.importorskip("cv2")


def camera_of(path: Path, **changes: object) -> CameraConfig:
    return CameraConfig(**{"device": str(path), "width": WIDTH, "height": HEIGHT, "rate": FPS, **changes})


def test_each_picture_has_the_time_at_which_the_file_shows_it(tmp_path: Path) -> None:
    before = time.monotonic()
    device = open_device(camera_of(write_video(tmp_path / "numbers.avi", range(5))))
    after = time.monotonic()
    shots = [device.read() for _ in range(12)]
    assert [number_in(shot.pixels) for shot in shots] == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1], "it plays in a loop"
    assert before <= shots[0].time <= after
    np.testing.assert_allclose([shot.time - shots[0].time for shot in shots], np.arange(12) / FPS, atol=1e-6)


def test_no_picture_is_given_before_the_time_of_its_capture(tmp_path: Path) -> None:
    device = open_device(camera_of(write_video(tmp_path / "numbers.avi", range(3))))
    for _ in range(3):
        shot = device.read()
        assert time.monotonic() >= shot.time


def test_a_video_that_is_not_repeated_ends_with_an_error(tmp_path: Path) -> None:
    device = open_device(camera_of(write_video(tmp_path / "numbers.avi", range(2)), repeat=False))
    assert [number_in(device.read().pixels) for _ in range(2)] == [0, 1]
    with pytest.raises(CameraError, match="the video has ended"):
        device.read()


def test_the_rotation_of_a_camera_turns_its_pictures_clockwise(tmp_path: Path) -> None:
    path = write_video(tmp_path / "numbers.avi", range(2))
    turned = camera_of(path, rotation=90, width=HEIGHT, height=WIDTH)
    device = open_device(turned)
    device.read()
    pixels = device.read().pixels
    assert pixels.shape == (WIDTH, HEIGHT, 3)
    # The left edge, on which number 1 is bright, becomes the upper edge.
    assert abs(float(pixels[:8].mean()) - float(numbered(1)[:, :8].mean())) < 10.0
    assert float(pixels[8:].mean()) < 10.0


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"width": 32}, "gives no 32x48; the nearest that it gives is 64x48; allowed: width: 64, height: 48"),
        ({"rotation": 90}, "gives no 64x48; the nearest that it gives is 48x64; allowed: width: 48, height: 64"),
    ],
)
def test_the_error_for_a_video_that_does_not_have_the_configured_size_names_the_size_of_the_video(
    tmp_path: Path, changes: dict[str, object], says: str
) -> None:
    with pytest.raises(CameraError, match=says):
        open_device(camera_of(write_video(tmp_path / "numbers.avi", range(2)), **changes))


def test_the_error_names_a_file_that_is_missing_or_is_no_video(tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("no video")
    for name, says in (("none.mp4", "no such file"), ("text.mp4", "no video that OpenCV can read")):
        with pytest.raises(CameraError, match=says) as error:
            open_device(camera_of(tmp_path / name))
        assert name in str(error.value)
