"""Episodes of recordings as vectors at a fixed rate, and the pictures that belong to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.features import Names, features
from q2r2_control.export.sampling import CameraFrames, sample
from q2r2_control.recording.episode_spans import WHOLE, EpisodeSpan, read_spans
from q2r2_control.recording.recorded_ticks import cell_and_robot_of
from q2r2_control.recording.ros_recording import open_recording

FASTEST = 1000  # [frames/s]


@dataclass(frozen=True)
class FrameSampling:
    """What becomes frames, and how many."""

    fps: int = 30
    trim: bool = False  # to the time in which arms are engaged or moving
    pictures: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.fps <= FASTEST:
            raise ConfigError(f"--fps {self.fps}: allowed: 1 .. {FASTEST}")


@dataclass(frozen=True)
class EpisodeVectors:
    """One recording as vectors, (n, size) float32 by feature."""

    recording: str  # name of its file
    cell: str
    task: str
    fps: int
    names: Names  # of the numbers of each feature
    notes: dict[str, str]  # program, machine, operator and the like, as recorded
    vectors: dict[str, npt.NDArray[np.float32]]
    success: bool | None = None  # None: nobody said
    part: int = 0  # which of the episodes in the file, from 1 on; 0: the whole
    cameras: Mapping[str, CameraFrames] = field(default_factory=dict)  # pictures by camera, one a frame

    @property
    def frames(self) -> int:
        return len(next(iter(self.vectors.values())))

    def outcome(self) -> dict[str, npt.NDArray[np.bool_]]:
        """(n,) whether a frame is the last one, and whether it is the last one of a success."""
        done = np.arange(self.frames) == self.frames - 1
        return {"next.done": done, "next.success": done & bool(self.success)}


def make_episode(file: Path, sampling: FrameSampling, span: EpisodeSpan | None = None) -> EpisodeVectors:
    """An episode of a recording, or the whole; its pictures are read when they are asked for.

    Raises :class:`RecordingError` that names the file and what is wrong.
    """
    recording = open_recording(file)
    span = span or replace(WHOLE, success=recording.conclusion.success)
    frames = sample(recording, sampling.fps, sampling.trim, span)
    cell, robot = cell_and_robot_of(recording)
    try:
        vectors, labels = features(frames, robot)
    except RecordingError as error:
        raise RecordingError(f"{recording.file}: {error}") from error
    notes = dict(recording.about.notes)
    task = notes.pop("task", "")
    cameras, stamps = recording.about.cameras if sampling.pictures else (), frames["stamp"].tolist()
    return EpisodeVectors(
        recording=recording.file.name,
        cell=cell.name,
        task=task,
        fps=sampling.fps,
        names=labels,
        notes=notes,
        vectors=vectors,
        success=span.success,
        part=span.number,
        cameras={name: CameraFrames(recording, name, cell.cameras[name], stamps) for name in cameras},
    )


def spans_to_export(file: Path) -> list[EpisodeSpan]:
    """The episodes of a recording but those that its operator discarded; of a file that cannot be read the whole."""
    try:
        return [span for span in read_spans(open_recording(file)) if not span.discarded]
    except RecordingError:
        return [WHOLE]  # make_episode says what is wrong with it
