"""The process of a camera goes on whatever the library of the camera raises."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from q2r2_control.cameras import camera_process
from q2r2_control.cameras.camera_process import CameraLost
from q2r2_control.config.recording import CameraConfig

CAMERA = CameraConfig(device=0, width=64, height=48, rate=30)


class Unplugged:
    """A camera that was unplugged. Its library raises its own exceptions, as those of OpenCV and RealSense do."""

    def read(self) -> Any:
        raise RuntimeError("the device\nis gone")

    def close(self) -> None:
        raise RuntimeError("the device is not streaming")


def requests() -> Iterator[CameraConfig]:
    """Give the settings of a camera. The run does not end."""
    yield CAMERA
    threading.Event().wait()


def test_a_camera_whose_library_raises_exceptions_of_its_own_is_lost_and_opened_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tries: Iterator[Unplugged | BaseException] = iter(
        [Unplugged(), RuntimeError("no such device"), Unplugged(), KeyboardInterrupt()]
    )

    def opened(camera: CameraConfig) -> Unplugged:
        found = next(tries)
        if isinstance(found, BaseException):
            raise found
        return found

    monkeypatch.setattr(camera_process, "open_device", opened)
    monkeypatch.setattr(camera_process, "_NICENESS", 0)
    monkeypatch.setattr(camera_process, "_RETRY", 0.0)
    answers: list[Any] = []
    with pytest.raises(KeyboardInterrupt):  # The last attempt ends the endless loop.
        camera_process.main(requests(), answers.append)
    assert answers == [CameraLost("the device is gone")] * 2
