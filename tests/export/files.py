"""Recordings for tests of the export, in which every number is known."""

from __future__ import annotations

import io
import pickle
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from PIL import Image

from q2r2_control.config.recording import CameraConfig
from q2r2_control.export.episodes import EpisodeVectors
from q2r2_control.export.sampling import Pixels
from q2r2_control.inputs.played import EvenSampling, PlayedInput
from q2r2_control.recording.about import About, Conclusion, as_yaml
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.messages import TICK, Message, array, picture, picture_topic
from q2r2_control.recording.tick_rows import numbers_in, tick_type
from q2r2_control.summary.tick import Tick
from q2r2_control.types import SIDES, HandInputs
from tests.recording.runs import ARMS, JOINTS, file_of, pipeline, record
from tests.support.processes import Watch, cell

EPOCH = 1_700_000_000_000_000_000  # [ns]
CHUNK = 7  # Number of ticks in a chunk.


def brightness(number: int) -> int:
    return 10 * number


def plain_jpeg(camera: CameraConfig, value: int) -> bytes:
    """Return a picture that is grey everywhere."""
    packed = io.BytesIO()
    Image.new("RGB", (camera.width, camera.height), (value, value, value)).save(packed, "JPEG", quality=95)
    return packed.getvalue()


def write_recording(
    path: Path,
    times: Sequence[int],
    *,
    numbers: Sequence[int] | None = None,
    engaged: Sequence[int] = (),
    moving: Sequence[int] = (),
    openings: Mapping[str, npt.ArrayLike] | None = None,
    cameras: Mapping[str, CameraConfig] | None = None,
    pictures: Mapping[str, Sequence[int]] | None = None,
) -> Path:
    """Write a recording with ticks at ``times`` [ns] since its start, and return its path.

    In tick k, every measured joint is at -k [rad], and every joint of the reference is at k [rad]. At the reference,
    the x coordinate of each tool is k [m].

    Args:
        path: The file of the recording.
        times: The times of the ticks since the start [ns].
        numbers: The numbers of the ticks. They are needed only if some ticks were lost.
        engaged: The ticks in which the left arm is engaged. In tick k, the x coordinate of its target is 1000 + k [m].
        moving: The ticks in which the reference moves.
        openings: For each name of a field with openings, its values (arms,).
        cameras: The cameras of the cell, by name.
        pictures: For each camera, the times at which its pictures were taken [ns]. Each picture is brighter than the
            picture before.
    """
    config = cell().model_copy(update={"cameras": dict(cameras or {})})
    how, cameras_of, notes = ("position", ("position",), EPOCH, False), tuple(config.cameras), {"task": "to count"}
    about = About(ARMS, JOINTS, *how, as_yaml(config), "<robot/>", cameras_of, notes)
    topics, at = about.topics(), np.arange(len(times))
    rows = np.zeros(len(times), dtype=tick_type(len(ARMS), len(JOINTS)))
    rows["index"] = at if numbers is None else numbers
    rows["q"], rows["v"], rows["tau"] = -at[:, None], -10 * at[:, None], -100 * at[:, None]
    rows["reference_q"], rows["reference_v"] = at[:, None], np.isin(at, moving)[:, None]
    arms = rows["arms"]
    arms["engaged"][:, 0] = np.isin(at, engaged)
    arms["tool"][:, :, 0], arms["tool"][:, :, 6] = at[:, None], 1.0
    arms["target"][list(engaged), 0] = arms["tool"][list(engaged), 0] + 1000.0 * np.eye(7)[0]
    for name, values in (openings or {}).items():
        arms[name] = values
    with BagWriter(path, topics.values(), about) as bag:
        for place, (row, time) in enumerate(zip(numbers_in(rows), times, strict=True)):
            payload = array(row)
            number, stamp = int(rows["index"][place]), EPOCH + time
            bag.write([Message(topics[TICK].channel, number, stamp, stamp, payload)])
            if place % CHUNK == CHUNK - 1:
                bag.flush()
        for name, taken in (pictures or {}).items():
            for number, time in enumerate(taken):
                jpeg, stamp = plain_jpeg(config.cameras[name], brightness(number)), EPOCH + time
                payload = picture(name, stamp, jpeg)
                bag.write([Message(topics[picture_topic(name)].channel, number, stamp, stamp, payload)])
        bag.close(Conclusion())
    return path


STEP_AT = 0.5  # [s]
DURATION = 0.9  # [s]


@dataclass(frozen=True)
class Run:
    file: Path
    ticks: list[Tick]


def step_of_the_hand(hand: str, t: float) -> pin.SE3:
    """Return the pose of a hand that rests, but is 1 cm farther left from :data:`STEP_AT` on."""
    return pin.SE3(np.eye(3), np.array([0.0, 0.01 if t >= STEP_AT else 0.0, 0.0]))


def press(hand: str, t: float) -> HandInputs:
    return HandInputs(button_lower=0.1 <= t < 0.2, button_upper=hand == "left" and STEP_AT <= t < STEP_AT + 0.1)


def record_step(folder: Path, duration: float = DURATION) -> Run:
    """Record a run with both arms engaged and a step of the hands.

    The positions of the plant's joints always equal the positions of the reference one tick earlier.
    """
    loop = pipeline(source=PlayedInput(step_of_the_hand, press, {side: EvenSampling(100.0) for side in SIDES}))
    watch = Watch(loop)
    return Run(file_of(record(folder, loop, duration)), watch.ticks)


def record_two(folder: Path) -> Sequence[Path]:
    """Record two runs of different lengths as :func:`record_step` does, and return their files."""
    return [record_step(folder, duration).file for duration in (DURATION, 0.6)]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


NAMES = {"observation.state": ("left_A1", "left_gripper"), "action": ("left_A1", "left_gripper", "right_A1")}
OUTCOMES = {1: True, 2: None, 3: False}
CAMERA, WIDTH, HEIGHT = "front", 64, 48


def episode(seed: int, frames: int, task: str) -> EpisodeVectors:
    random = np.random.default_rng(seed)
    vectors = {name: random.normal(size=(frames, len(labels))).astype(np.float32) for name, labels in NAMES.items()}
    about = (f"run-{seed}.mcap", "two_arms", task, 30, NAMES, {"operator": "Ada"})
    return EpisodeVectors(*about, vectors, success=OUTCOMES[seed])


EPISODES = (episode(1, 40, "stack"), episode(2, 25, "circle"), episode(3, 60, "stack"))


@dataclass(frozen=True)
class Waves:
    """A smooth moving pattern, which an encoder of videos preserves."""

    frames: int
    seed: int
    size: tuple[int, int, int] = (HEIGHT, WIDTH, 3)
    dtype: str = "uint8"
    unit: float = 1e-3
    config: CameraConfig = field(default_factory=lambda: CameraConfig(position=(1, 0, 1), rpy=(0, 0, 0)))

    def __iter__(self) -> Iterator[Pixels]:
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        for frame in range(self.frames):
            waves = [np.sin(0.1 * x + 0.07 * (channel + 1) * y + 0.3 * frame + self.seed) for channel in range(3)]
            yield (128 + 100 * np.stack(waves, axis=-1)).astype(self.dtype)


def with_subtasks(plain: EpisodeVectors, *lengths: tuple[str, int]) -> EpisodeVectors:
    """Return an episode that has subtasks with these names and numbers of frames.

    The last subtask goes on to the end of the episode.
    """
    index = [number for number, (_, frames) in enumerate(lengths) for _ in range(frames)]
    index += [len(lengths) - 1] * (plain.frames - len(index))
    return replace(plain, subtasks=tuple(name for name, _ in lengths), subtask=tuple(index))


# Two episodes that have a subtask in common, and an episode without subtasks.
TOLD = (
    with_subtasks(EPISODES[0], ("reach", 15), ("grasp the cube", 25)),
    with_subtasks(EPISODES[1], ("grasp the cube", 10), ("place", 15)),
    EPISODES[2],
)


def with_pictures(plain: EpisodeVectors, seed: int) -> EpisodeVectors:
    pictures: Any = Waves(plain.frames, seed)
    return replace(plain, cameras={CAMERA: pictures}, depths={CAMERA: replace(pictures, dtype="uint16")})


def write_vectors(episode: EpisodeVectors, path: Path) -> None:
    """Write an episode into a file, as the formats of the export do."""
    path.write_bytes(pickle.dumps(replace(episode, cameras={}, depths={})))


def load_vectors(path: Path) -> EpisodeVectors:
    episode: EpisodeVectors = pickle.loads(path.read_bytes())
    return episode
