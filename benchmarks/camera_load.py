"""Do ten real cameras slow down the loop, while they are recorded, and while a policy observes them?

All runs are in real time. Scripted hands, or a policy, move both arms round circles, once without cameras and once with
them. All cameras play the same video file. A process for each camera reads and compresses the pictures on this machine,
as it would with a device.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import cv2
import numpy as np
from typer import Option, run

from q2r2_control.cameras.camera_streams import CameraStreams
from q2r2_control.cli.output import DEMO_CONFIG, Json, print_progress, print_report
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.config.recording import CameraConfig
from q2r2_control.inputs.base import Input
from q2r2_control.inputs.policy import PolicyInput
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.about import About
from q2r2_control.recording.device_pictures import DevicePictures
from q2r2_control.recording.recorder import ROOM_WITH_PICTURES, Recorder
from q2r2_control.viewer.tables import record_table

WIDTH, HEIGHT, RATE = 640, 480, 30  # Size of the pictures [pixels], and pictures per second.
POLICY = "examples.policy:Circles"
_SECONDS = 4  # Duration of the video, which is repeated [s].
NOTES = (
    "tick: from the inputs until the command is applied; late: of the beginnings of ticks, p99",
    "cpu: processor time of the loop's thread from tick to tick, with its listeners, whatever else runs",
    "tracking: RMS of the worse tool behind its target; missed: ticks that the loop left out because it was late",
    "dropped: pictures that were due and are not in the file",
)


@dataclass(frozen=True)
class RunFigures:
    """The figures of one run; times of ticks in [us]."""

    name: str
    loop_rate_hz: float
    tick_p50: float | None
    tick_p99: float | None
    late_p99: float | None
    cpu_p50: float
    cpu_p99: float
    missed: int
    tracking_mm: float | None  # RMS error of the tool with the larger error; None if no arm was engaged.
    pictures: int
    dropped: int


def write_video(path: Path) -> Path:
    """Write a video of a textured picture that moves, with the noise of a camera."""
    random = np.random.default_rng(0)
    texture = cv2.resize(random.integers(0, 256, (HEIGHT // 8, WIDTH // 8, 3), dtype=np.uint8), (WIDTH, HEIGHT))
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), RATE, (WIDTH, HEIGHT))
    for number in range(_SECONDS * RATE):
        noise = random.integers(0, 8, texture.shape, dtype=np.uint8)
        writer.write(cv2.add(np.roll(texture, 4 * number, axis=1), noise))
    writer.release()
    return path


def measure(name: str, config: Config, source: Input, plant: str, duration: float, folder: Path) -> RunFigures:
    """Return the figures of one run of ``duration`` [s]."""
    print_progress(name)
    pipeline = Pipeline.from_config(config, input=source, plant=plant)
    with ExitStack() as stack:
        streams = pipeline.cameras = stack.enter_context(CameraStreams(config.device_cameras))
        recorder = stack.enter_context(Recorder(folder, "load", room=ROOM_WITH_PICTURES))
        streams.wait_until_ready()
        about = About.of(pipeline, True, {}, tuple(config.device_cameras))
        recorder.begin(about, pipeline.robot)
        devices = DevicePictures(streams, True, pipeline.record_outcome, (recorder, about))
        used: list[float] = []  # Processor time of the loop's thread up to each tick [s].
        pipeline.listeners += [recorder, stack.enter_context(devices), lambda _: used.append(time.thread_time())]
        summary = pipeline.run(duration)
    errors = [arm.position_error_mm_rms for arm in summary.arms.values() if arm.position_error_mm_rms is not None]
    recording, per_tick = recorder.summary, 1e6 * np.diff(used)
    return RunFigures(
        name=name,
        loop_rate_hz=summary.loop_rate_hz,
        tick_p50=summary.tick_us.p50,
        tick_p99=summary.tick_us.p99,
        late_p99=summary.lateness_us.p99,
        cpu_p50=float(np.median(per_tick)),
        cpu_p99=float(np.percentile(per_tick, 99)),
        missed=summary.missed_ticks,
        tracking_mm=max(errors, default=None),
        pictures=recording.pictures,
        dropped=recording.lost_pictures,
    )


def main(
    duration: Annotated[float, Option(min=1.0, help="Of each run [s].")] = 20.0,
    cameras: Annotated[int, Option(min=1, max=16, help="Number of cameras.")] = 10,
    plant: Annotated[str, Option(help="An installed plant.")] = "kinematic",
    json: Json = False,
) -> None:
    """Measure runs without and with cameras, in which scripted hands or a policy move the arms."""
    figures = []
    with TemporaryDirectory() as kept:
        folder = Path(kept)
        camera = CameraConfig(device=str(write_video(folder / "camera.avi")), width=WIDTH, height=HEIGHT, rate=RATE)
        cell = load_config(DEMO_CONFIG)
        for leader in ("hands", "policy"):
            for count in (0, cameras):
                config = cell.model_copy(update={"cameras": dict.fromkeys(map("c{}".format, range(count)), camera)})
                title = f"{leader}, {count or 'no'} cameras"
                source = ScriptedInput("circle") if leader == "hands" else PolicyInput.from_config(config, POLICY)
                figures.append(measure(title, config, source, plant, duration, folder / "recordings"))
    table = record_table(f"{cameras} cameras of {WIDTH}x{HEIGHT} at {RATE} pictures a second", figures, NOTES)
    print_report({"duration_s": duration, "runs": [asdict(each) for each in figures]}, (table,), json)


if __name__ == "__main__":
    run(main)
