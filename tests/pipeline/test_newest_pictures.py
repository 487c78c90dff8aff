"""A policy sees the newest picture of each camera, with the time of its capture on the loop's clock."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from q2r2_control.cameras.camera_process import CameraShot
from q2r2_control.cameras.camera_streams import CameraStreams
from q2r2_control.config.recording import CameraConfig
from q2r2_control.errors import CameraError
from q2r2_control.inputs.policy import PolicyInput
from q2r2_control.pipeline.newest_pictures import NewestPictures
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.recording.device_pictures import DevicePictures
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array, Observation
from tests.cameras.videos import FPS, HEIGHT, WIDTH, number_in, number_of_jpeg, write_video
from tests.recording.runs import ROOT, pipeline
from tests.support.pictures import needs_opengl

COUNT = 200  # Number of pictures in the video.
LONGEST = 60.0  # Longest duration of a run whose end condition is never met [s]. Most runs are much shorter.
ENOUGH = 12  # Number of different pictures that a policy has to see.
SIMULATED = {"position": (1.9, 0.0, 1.0), "look_at": (0.4, 0.0, 0.3), "width": 64, "height": 48, "rate": 30}


def front(path: Path, **changes: object) -> CameraConfig:
    values = {"device": str(path), "width": WIDTH, "height": HEIGHT, "rate": FPS, **changes}
    return CameraConfig.model_validate(values)


class Seeing:
    """A policy that holds the arms, and stores the number and the capture time of each picture of its camera."""

    rate = 50.0

    def __init__(self) -> None:
        self.seen: list[tuple[float, int]] = []  # Time of each capture [s], and the number in the picture.

    def __call__(self, observation: Observation) -> Array:
        picture = observation.pictures["front"]
        if not self.seen or picture.time != self.seen[-1][0]:
            self.seen.append((picture.time, number_in(picture.pixels)))
        return observation.state.q


class Run:
    """A run whose camera is a video file. It ends when ``during`` returns True."""

    def __init__(
        self,
        camera: CameraConfig,
        policy: Callable[[Observation], Array],
        during: Callable[[Tick], bool],
        realtime: bool = True,
    ) -> None:
        self.loop = pipeline(source=PolicyInput(policy), cameras={"front": camera})
        self.shots: list[tuple[float, int]] = []  # Time of each capture on the computer's clock [s], and the number.
        self.ticks: list[Tick] = []

        def stop(tick: Tick) -> None:
            self.ticks.append(tick)
            if during(tick):
                self.loop.stop()

        with CameraStreams(self.loop.config.device_cameras) as streams:
            streams.wait_until_ready()
            streams.streams["front"].hear(self._note)
            self.loop.cameras = streams
            with DevicePictures(streams, realtime, self.loop.record_outcome) as devices:
                self.loop.listeners += [devices, stop]
                self.loop.run(realtime=realtime, paced=True)

    def _note(self, shot: CameraShot) -> None:
        self.shots.append((shot.time, number_of_jpeg(shot.jpeg)))


def test_each_picture_that_a_policy_sees_has_the_time_of_its_own_capture(tmp_path: Path) -> None:
    policy = Seeing()
    run = Run(front(write_video(tmp_path / "front.avi", range(COUNT))), policy, lambda _: len(policy.seen) >= ENOUGH)
    captured = {round(time, 6): number for time, number in run.shots}
    first, *others = policy.seen  # The first picture may be older than all pictures in ``run.shots``.
    assert [captured[round(time, 6)] for time, _ in others] == [number for _, number in others]
    start = first[0] - first[1] / FPS
    passed = [round((time - start) * FPS) % COUNT for time, _ in policy.seen]
    assert passed == [number for _, number in policy.seen], "the file's own times"


def test_in_simulated_time_the_time_of_a_picture_is_a_time_of_the_loops_clock(tmp_path: Path) -> None:
    policy = Seeing()
    camera = front(write_video(tmp_path / "front.avi", range(COUNT)))

    def saw_enough(tick: Tick) -> bool:
        return (len(policy.seen) >= ENOUGH and policy.seen[-1][0] > 0.0) or tick.t > LONGEST

    run = Run(camera, policy, saw_enough, realtime=False)
    begin, end = run.ticks[0].now, run.ticks[-1].now
    times = [time for time, _ in policy.seen]
    assert times == sorted(times)
    # On a busy machine, several pictures that were captured before the run arrive during it. Their times are negative.
    assert begin - LONGEST < times[0] <= times[-1] <= end, (begin, end, times)
    assert times[-1] > 0.0, (begin, end, times)
    assert run.ticks[0].now < 1.0, "the clock of the loop is another one than that of the computer"


class Reading(Seeing):
    """A policy that stores the message of the error if a picture cannot be read."""

    why = ""

    def __call__(self, observation: Observation) -> Array:
        try:
            return super().__call__(observation)
        except CameraError as error:
            self.why = str(error)
            raise


class Careless(Seeing):
    """A policy that goes on without pictures."""

    without = False

    def __call__(self, observation: Observation) -> Array:
        self.without = "front" not in observation.pictures
        return observation.state.q


def test_if_a_policy_reads_a_camera_that_has_stopped_the_arms_stop_and_one_line_is_printed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    policy, video = Reading(), write_video(tmp_path / "short.avi", range(5))

    def told() -> list[str]:
        return [line for line in caplog.messages if line.startswith("camera front: no picture for")]

    def is_over(tick: Tick) -> bool:
        return bool(policy.why and told()) and "policy" not in tick.states.values()

    with caplog.at_level(logging.WARNING):
        run = Run(front(video, repeat=False), policy, lambda tick: is_over(tick) or tick.t > LONGEST)
    assert re.fullmatch(r"camera front: no picture for \d+\.\d s: the video has ended", policy.why)
    assert set([tick for tick in run.ticks if tick.following][-1].states.values()) == {"lost"}
    assert len(told()) == 1
    assert not any("Traceback" in line for line in caplog.messages)


def test_a_policy_that_does_not_read_a_camera_goes_on_when_the_camera_stops(tmp_path: Path) -> None:
    policy, video = Careless(), write_video(tmp_path / "short.avi", range(5))

    def goes_on(tick: Tick) -> bool:
        return policy.without and set(tick.states.values()) == {"policy"}

    run = Run(front(video, repeat=False), policy, lambda tick: goes_on(tick) or tick.t > LONGEST)
    assert run.ticks[-1].t <= LONGEST


@pytest.mark.parametrize(
    ("name", "camera", "says"),
    [
        ("front", {"device": "front.avi"}, "camera front: this run has not opened it"),
        ("front", {"topic": "/front"}, "camera front: its pictures are on a ROS topic; allowed: of simulated cameras"),
        ("front", SIMULATED, "camera front: it is simulated, and this plant has no pictures"),
        ("hand", SIMULATED, "camera 'hand': no such camera; allowed: front"),
    ],
)
def test_an_access_to_a_camera_without_pictures_raises_an_error_with_the_reason(
    name: str, camera: dict[str, Any], says: str
) -> None:
    loop = pipeline(cameras={"front": CameraConfig.model_validate(camera)})
    pictures = NewestPictures(loop.config, loop.plant, None).at(1.0)
    assert pictures.get(name) is None
    with pytest.raises(CameraError, match=says):
        pictures[name]


def simulated(policy: Callable[[Observation], Array]) -> Pipeline:
    cameras = {"front": CameraConfig.model_validate(SIMULATED)}
    return pipeline(plant="mujoco", source=PolicyInput(policy, rate=100.0), cameras=cameras)


def test_a_simulated_camera_gives_one_picture_in_each_of_its_periods() -> None:
    times: list[float] = []

    def hold(observation: Observation) -> Array:
        times.append(observation.pictures["front"].time)
        return observation.state.q

    loop = simulated(hold)
    loop.run(0.2, realtime=False)
    first = times[0]
    found = np.array(sorted(set(times))) - first
    np.testing.assert_allclose(found, np.arange(6) / 30.0, atol=1.0 / loop.config.nominal_rate_hz)
    assert (found >= np.arange(6) / 30.0 - 1e-6).all(), "none is taken early"


def compare_pictures() -> None:
    """Compare pictures that a policy gets with pictures that are drawn directly from the plant at the same tick."""
    from q2r2_control.plants.mujoco import MujocoPlant
    from q2r2_control.plants.mujoco_cameras import CellPictures

    same: list[bool] = []

    def hold(observation: Observation) -> Array:
        picture = observation.pictures["front"]
        if picture.time == observation.time:
            assert isinstance(loop.plant, MujocoPlant)
            cell.place(loop.plant.observed_qpos)
            same.append(bool((picture.pixels == cell.take("front")).all()) and picture.pixels.std() > 10)
        return observation.state.q + 0.01

    loop = simulated(hold)
    assert isinstance(loop.plant, MujocoPlant)
    cell = CellPictures(loop.plant.model, loop.config.simulated_cameras)
    loop.run(0.2, realtime=False)
    print(len(same), all(same))


@pytest.mark.slow
def test_a_policy_sees_a_simulated_cell_as_it_was_at_the_tick() -> None:
    needs_opengl()
    code = "from tests.pipeline.test_newest_pictures import compare_pictures; compare_pictures()"
    environment = {"MUJOCO_GL": "egl", **os.environ}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    count, same = done.stdout.split() or ("0", done.stderr)
    assert (int(count) >= 2, same) == (True, "True")
