"""Colour and depth of a RealSense camera come from the software device of its library, so no camera is needed."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from q2r2_control.cameras import camera_process, realsense
from q2r2_control.cameras.camera_process import CameraShot, DepthShot
from q2r2_control.cameras.device import Capture, DepthCapture
from q2r2_control.cameras.opening import open_device
from q2r2_control.cameras.realsense import RealSense, described
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError, ConfigError
from tests.cameras.software_realsense import FPS, SERIAL, UNIT, SoftwareRealSense, StoppedClock
from tests.cameras.videos import HEIGHT, WIDTH, number_in, number_of_jpeg

pytest.importorskip("pyrealsense2")
pytest.importorskip("cv2")

DEEP = np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH) * 21  # The values need all 16 bits.


def camera(**changes: object) -> CameraConfig:
    values = {"device": f"realsense:{SERIAL}", "width": WIDTH, "height": HEIGHT, "rate": FPS, **changes}
    return CameraConfig.model_validate(values)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> StoppedClock:
    clock = StoppedClock()
    monkeypatch.setattr(realsense, "time", clock)
    return clock


def test_colour_and_depth_have_the_time_of_their_capture(clock: StoppedClock) -> None:
    source = SoftwareRealSense()
    device = RealSense(camera(depth=True), source.device)
    captured = clock.time() - 0.2
    source.show(5, captured)
    source.show_depth(DEEP, captured + 0.1)
    colour, depth = device.read(), device.read()
    device.close()
    assert isinstance(colour, Capture)
    assert number_in(colour.pixels) == 5
    assert isinstance(depth, DepthCapture)
    np.testing.assert_array_equal(depth.pixels, DEEP)
    assert depth.unit == pytest.approx(UNIT)
    assert (colour.time, depth.time) == pytest.approx((99.8, 99.9), abs=1e-3)


def test_without_depth_only_the_colour_picture_is_read_and_turned(clock: StoppedClock) -> None:
    source = SoftwareRealSense()
    device = RealSense(camera(rotation=90, width=HEIGHT, height=WIDTH), source.device)
    source.show_depth(DEEP, clock.time())
    source.show(1, clock.time())
    captured = device.read()
    assert captured.pixels.shape == (WIDTH, HEIGHT, 3)
    assert isinstance(captured, Capture)
    with pytest.raises(CameraError, match="no frame within 2 s"):
        device.read()
    device.close()


def test_it_is_a_fault_if_the_depth_stream_falls_silent_and_the_colour_stream_goes_on(clock: StoppedClock) -> None:
    source = SoftwareRealSense()
    device = RealSense(camera(depth=True), source.device)
    clock.passed = 2.5
    source.show(1, clock.time())
    with pytest.raises(CameraError, match="no depth within 2 s"):
        device.read()
    device.close()


def test_the_error_for_a_size_that_the_camera_does_not_give_names_the_nearest_size() -> None:
    with pytest.raises(CameraError, match=f"gives no 32x48; .* allowed: width: {WIDTH}, height: {HEIGHT}"):
        RealSense(camera(width=32), SoftwareRealSense().device)


def test_the_error_for_a_camera_that_is_not_connected_says_what_is_allowed() -> None:
    with pytest.raises(CameraError, match="realsense:042: no such camera; allowed: "):
        open_device(camera())


def test_a_camera_is_described_by_its_serial_number_its_name_and_its_formats() -> None:
    found = described(SoftwareRealSense().device)
    size = f"{WIDTH}x{HEIGHT} at {FPS}/s"
    assert found == (SERIAL, "a camera", (f"color {size}", f"depth {size}"))


@pytest.mark.parametrize("changes", [{"device": 0}, {"device": "a.mp4"}])
def test_depth_is_refused_for_a_camera_that_is_no_realsense(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="depth: allowed: with device: realsense:SERIAL"):
        camera(depth=True, **changes)


def test_the_process_of_a_camera_passes_depth_on_without_loss(clock: StoppedClock) -> None:
    source = SoftwareRealSense()
    device = RealSense(camera(depth=True), source.device)
    begin = clock.time() - 0.5
    for number in range(2):
        source.show(number, begin + number / FPS)
        source.show_depth(DEEP + np.uint16(number), begin + number / FPS)
    answers: list[Any] = []
    with pytest.raises(CameraError, match="no frame within 2 s"):
        camera_process._pass_on(device, camera(depth=True), answers.append)
    device.close()
    shots = [one for one in answers if isinstance(one, CameraShot)]
    depths = [one for one in answers if isinstance(one, DepthShot)]
    assert [number_of_jpeg(shot.jpeg) for shot in shots] == [0, 1]
    assert len(depths) == len(shots)
    for number, depth in enumerate(depths):
        pixels = np.asarray(Image.open(io.BytesIO(depth.png)))
        np.testing.assert_array_equal(pixels, DEEP + np.uint16(number))
        assert depth.unit == pytest.approx(UNIT)
        assert depth.time == pytest.approx(99.5 + number / FPS, abs=1e-3)
