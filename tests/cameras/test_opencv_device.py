"""Live cameras: the times at which their pictures were captured, and cameras on the network."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from PIL import Image

from q2r2_control.cameras.opening import open_device
from q2r2_control.cameras.v4l2 import fault_of
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError
from tests.cameras.videos import HEIGHT, WIDTH, number_in, numbered

pytest.importorskip("cv2")


@pytest.mark.parametrize(
    ("stamp_ms", "captured"),
    [
        pytest.param(99_960.0, 99.96, id="a stamp of the monotonic clock counts"),
        pytest.param(100_000.0, 100.0, id="so does one of right now"),
        pytest.param(0.0, 99.9, id="without a stamp it is the receipt less the delay"),
        pytest.param(2_500.0, 99.9, id="a stamp since the stream began does not count"),
        pytest.param(100_500.0, 99.9, id="a stamp of the future does not count"),
    ],
)
def test_a_picture_has_the_time_that_the_driver_stamped_if_this_time_is_possible(
    stamp_ms: float, captured: float
) -> None:
    from q2r2_control.cameras.device import capture_time

    assert capture_time(100.0, stamp_ms, 0.1) == pytest.approx(captured)


class Stream(BaseHTTPRequestHandler):
    """A network camera that sends Motion JPEG over HTTP. Each picture shows its own number."""

    sent: dict[int, float]  # For each picture's number, the time just before it was sent [s].
    paths: list[str]  # The paths of all requests.

    def do_GET(self) -> None:
        self.paths.append(self.path)
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace;boundary=picture")
        self.end_headers()
        with suppress(OSError):  # The client has closed the connection.
            for number in range(200):
                packed = io.BytesIO()
                Image.fromarray(numbered(number)).save(packed, "JPEG", quality=90)
                jpeg = packed.getvalue()
                self.sent[number] = time.monotonic()
                head = f"--picture\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
                time.sleep(0.02)

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@pytest.fixture
def address() -> Iterator[str]:
    Stream.sent, Stream.paths = {}, []
    server = ThreadingHTTPServer(("127.0.0.1", 0), Stream)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/stream.mjpg"
    server.shutdown()
    server.server_close()


def test_the_capture_time_of_a_network_cameras_picture_is_its_receipt_minus_the_delay(address: str) -> None:
    delay = 1.5
    device = open_device(CameraConfig(device=address, width=WIDTH, height=HEIGHT, delay=delay))
    shots = [device.read() for _ in range(5)]
    received = time.monotonic()
    device.close()
    numbers = [number_in(shot.pixels) for shot in shots]
    assert numbers == sorted(set(numbers))
    for number, shot in zip(numbers, shots, strict=True):
        assert Stream.sent[number] - delay <= shot.time <= received - delay


def test_a_network_camera_whose_pictures_do_not_have_the_configured_size_is_refused(address: str) -> None:
    with pytest.raises(CameraError, match=f"allowed: width: {WIDTH}, height: {HEIGHT}"):
        open_device(CameraConfig(device=address, width=WIDTH, height=2 * HEIGHT))


def test_an_environment_variable_in_an_address_is_replaced_by_its_value(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAMERA_STREAM", "stream.mjpg")
    secret = address.replace("stream.mjpg", "$CAMERA_STREAM")
    open_device(CameraConfig(device=secret, width=WIDTH, height=HEIGHT)).close()
    assert Stream.paths == ["/stream.mjpg"]


def test_an_error_about_an_address_does_not_contain_its_password() -> None:
    with pytest.raises(CameraError, match=r"http://127\.0\.0\.1:9/stream: no stream of pictures") as error:
        open_device(CameraConfig(device="http://me:secret@127.0.0.1:9/stream"))
    assert "secret" not in str(error.value)


def test_the_function_fault_of_says_why_a_name_is_not_the_name_of_a_camera() -> None:
    assert str(fault_of("/dev/video250")).startswith("no such device; allowed: ")
    assert fault_of("/dev/null") == "no camera: it is no V4L2 device"
