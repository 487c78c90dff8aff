"""``q2r2 cameras``: list the cameras of this computer, and take a picture with each camera of a cell."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console
from typer import Argument, Exit, Option

from q2r2_control.cameras.camera_streams import CameraStream
from q2r2_control.cameras.device import shown_device
from q2r2_control.cameras.realsense import found_cameras, is_installed
from q2r2_control.cameras.v4l2 import capture_devices, fault_of, formats_of
from q2r2_control.cli.output import Json, as_json_text
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.recording import REALSENSE, CameraConfig
from q2r2_control.errors import CameraError
from q2r2_control.extras import install_line
from q2r2_control.process.folders import check_folder
from q2r2_control.process.helper_process import reason_of

_MEASURED = 1.0  # Time over which the rate of a camera is measured [s].
_LONGEST = 5.0  # Longest time to wait for the last picture of this measurement [s].


@dataclass(frozen=True, slots=True)
class FoundDevice:
    """A V4L2 device or a RealSense camera of this computer."""

    path: str  # The value to write into the YAML as cameras.NAME.device.
    name: str
    formats: list[str]
    fault: str | None  # The reason why the device cannot be opened; None if it can.


@dataclass(frozen=True, slots=True)
class TriedCamera:
    """A camera of the cell, and the result of the attempt to take a picture with it."""

    name: str
    device: str
    picture: str | None = None  # The path of the file with the picture.
    width: int | None = None  # Width of the picture [pixels].
    height: int | None = None  # Height of the picture [pixels].
    rate: float | None = None  # Pictures per second, computed from the times at which they were captured.
    fault: str | None = None  # The reason why there is no picture; None if there is one.

    @property
    def line(self) -> str:
        what = self.fault or f"{self.width}x{self.height}, {self.rate or 0.0:.1f} pictures a second: {self.picture}"
        return f"{self.name} ({self.device}): {what}"


def cameras(
    config: Annotated[str | None, Argument(metavar="[CONFIG]", help="YAML of a cell with cameras.NAME.device.")] = None,
    output: Annotated[Path, Option(metavar="DIR", help="Folder for a picture of each camera.")] = Path("cameras"),
    json: Json = False,
) -> None:
    """List the cameras of this computer, and take a picture with each one of a cell; exit 1 where one gives none."""
    configured = {} if config is None else load_config(config).device_cameras
    found = list(_found_devices())
    if configured:
        check_folder(output, "--output")
    tried = [_tried(name, camera, output) for name, camera in configured.items()]
    if json:
        print(as_json_text({"devices": found, "cameras": tried}))
    else:
        _print(found, tried, config)
    raise Exit(int(any(one.fault for one in tried)))


def _found_devices() -> Iterator[FoundDevice]:
    for path, name in capture_devices().items():
        formats, fault = [], fault_of(path)
        if fault is None:
            try:
                formats = [str(one) for one in formats_of(path)]
            except OSError as error:
                fault = f"its formats cannot be listed: {error.strerror}"
        yield FoundDevice(path, name, formats, fault)
    for camera, _ in found_cameras():
        yield FoundDevice(f"{REALSENSE}{camera.serial}", camera.name, list(camera.formats), None)


def _tried(name: str, camera: CameraConfig, folder: Path) -> TriedCamera:
    device, file = shown_device(camera), folder / f"{name}.jpg"
    try:
        stream = CameraStream(name, camera)
    except CameraError as error:
        return TriedCamera(name, device, fault=str(error))
    try:
        first = stream.first_picture()
        stream.wait_for_pictures_until(first.time + _MEASURED, _LONGEST)
        times = [shot.time for _, shot in stream.take()]
        rate = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else None
        file.write_bytes(first.jpeg)
    except (CameraError, OSError) as error:
        return TriedCamera(name, device, fault=reason_of(error))
    finally:
        stream.process.kill()
    return TriedCamera(name, device, str(file), first.width, first.height, rate)


def _print(found: list[FoundDevice], tried: list[TriedCamera], config: str | None) -> None:
    console = Console(soft_wrap=True, highlight=False, markup=False)
    for device in found:
        console.print(f"{device.path}: {device.name}{'' if device.fault is None else f': {device.fault}'}")
        for line in device.formats:
            console.print(f"    {line}")
    if not found:
        console.print("no V4L2 camera on this computer")
    if not is_installed():
        console.print(f"RealSense cameras are listed as V4L2 devices only: {install_line('realsense')}")
    for one in tried:
        console.print(one.line, style="red" if one.fault else None)
    if config is not None and not tried:
        console.print(f"{config}: no camera has a device")
