"""Converts episodes of recordings to vectors and pictures at a fixed rate.

Several processes or machines can share the work. Each finished episode is stored in a folder until all are finished.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, field, replace
from operator import attrgetter
from pathlib import Path

import numpy as np
import numpy.typing as npt

from q2r2_control.config.recording import subtask_names
from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.sampling import CameraFrames, Names, Vectors, features, sample, units_of
from q2r2_control.inputs.policy import ActionSpace
from q2r2_control.process.helper_process import reason_of
from q2r2_control.process.places import HERE, JobPlace
from q2r2_control.recording.about import anonymous
from q2r2_control.recording.messages import NANOSECONDS
from q2r2_control.recording.reader import BROKEN, WHOLE, EpisodeSpan, read_spans
from q2r2_control.recording.recorded_ticks import cell_and_robot_of
from q2r2_control.recording.ros_recording import open_recording

FASTEST = 1000  # The highest rate of frames [Hz].
_OUTPUT = "allowed: a new folder where you may write"
SUBTASK = "subtask_index"  # lerobot's name of the column with the index of each frame's subtask.
_FORMAT = 9  # The version of stored episodes. Episodes of another version are made again.


@dataclass(frozen=True)
class FrameSampling:
    """Settings for the frames that are made from the ticks, and for the data that is exported with them.

    Raises :class:`ConfigError` unless ``fps`` is 1 to 1000 and ``ahead`` is 0 to ``fps``.
    """

    fps: int = 30  # The number of frames per second.
    trim: bool = False  # Whether frames before the first and after the last motion or engagement are left out.
    pictures: bool = False  # Whether pictures are exported.
    anonymous: bool = False  # Whether notes that identify a person or a computer are left out.
    ahead: int = 0  # Number of frames by which position actions are shifted to earlier rows.

    def __post_init__(self) -> None:
        if not 1 <= self.fps <= FASTEST:
            raise ConfigError(f"--fps {self.fps}: allowed: 1 .. {FASTEST}")
        if not 0 <= self.ahead <= self.fps:
            raise ConfigError(f"--ahead {self.ahead}: allowed: 0 .. {self.fps}, the frames of a second")


@dataclass(frozen=True)
class EpisodeVectors:
    """One episode with n frames, as vectors: for each feature, an array (n, size) of float32."""

    recording: str  # The name of the recording's file.
    cell: str
    task: str
    fps: int
    names: Names  # The names of the numbers of each feature.
    notes: dict[str, str]  # The recorded notes, such as program, machine and operator.
    vectors: Vectors
    success: bool | None = None  # Whether the episode succeeded; None if that is not known.
    # Number of frames by which position actions are shifted. Row k contains the position action of frame k + ahead.
    ahead: int = 0
    part: int = 0  # The number of the episode in the file, from 1 on; 0 for the whole file.
    cameras: Mapping[str, CameraFrames] = field(default_factory=dict)  # For each camera, one picture per frame.
    depths: Mapping[str, CameraFrames] = field(default_factory=dict)  # Depth, if it is recorded.
    subtasks: tuple[str, ...] = ()  # The names of the episode's subtasks, in their order; empty if it has none.
    subtask: tuple[int, ...] = ()  # For each frame, the index of its subtask in ``subtasks``; empty without subtasks.

    @property
    def units(self) -> Names:
        """Return the unit of each number, by feature, in the order of ``names``."""
        return units_of(self.names)

    @property
    def frames(self) -> int:
        return len(next(iter(self.vectors.values())))

    def outcome(self) -> dict[str, npt.NDArray[np.bool_]]:
        """Return two columns of flags (n,) by name.

        ``next.done`` is True at the last frame. ``next.success`` is True at the last frame if the episode succeeded.
        """
        done = np.arange(self.frames) == self.frames - 1
        return {"next.done": done, "next.success": done & bool(self.success)}


def make_episode(file: Path, sampling: FrameSampling, span: EpisodeSpan | None = None) -> EpisodeVectors:
    """Make the vectors and pictures of an episode.

    Args:
        file: The recording.
        sampling: The rate of the frames, and what they contain.
        span: The part of the recording; None for the whole recording.

    Returns:
        The episode. ``vectors`` has an array (frames, size) for each feature of a dataset.

    Raises:
        RecordingError: If the recording cannot be read or has nothing to export. The error names the file.
    """
    recording = open_recording(file)
    span = span or replace(WHOLE, success=recording.conclusion.success)
    frames = sample(recording, sampling.fps, sampling.trim, span)
    cell, robot = cell_and_robot_of(recording)
    try:
        vectors, labels = features(frames, robot)
    except RecordingError as error:
        raise RecordingError(f"{recording.file}: {error}") from error
    # Actions that are motions already describe the motion to the next frame, so they are not shifted.
    for action in (ActionSpace.JOINTS, ActionSpace.TOOL):
        vectors[action] = _earlier(vectors[action], sampling.ahead)
    notes = dict(recording.about.notes)
    notes = anonymous(notes) if sampling.anonymous else notes
    task = notes.pop("task", "")
    stamps = frames["stamp"].tolist()

    def pictures(names: Sequence[str], is_depth: bool) -> dict[str, CameraFrames]:
        shown = names if sampling.pictures else ()
        return {name: CameraFrames(recording, name, cell.cameras[name], stamps, is_depth) for name in shown}

    # These times are measured from the start of the run, as the times in ``subtask_starts`` are.
    passed = (frames["stamp"] - recording.about.epoch) / NANOSECONDS
    subtasks = subtask_names(cell.recording.subtasks, len(span.subtask_starts))
    number = np.searchsorted(np.array(span.subtask_starts), passed, side="right")
    return EpisodeVectors(
        recording=recording.file.name,
        cell=cell.name,
        task=task,
        fps=sampling.fps,
        names=labels,
        notes=notes,
        vectors=vectors,
        success=span.success,
        ahead=sampling.ahead,
        part=span.number,
        cameras=pictures(recording.about.cameras, is_depth=False),
        depths=pictures(recording.about.depth, is_depth=True),
        subtasks=subtasks,
        subtask=tuple(number.tolist()) if subtasks else (),
    )


def _earlier(rows: npt.NDArray[np.float32], frames: int) -> npt.NDArray[np.float32]:
    """Return ``rows`` (n, size) shifted by ``frames`` to earlier frames. The last row is repeated at the end."""
    return rows[np.minimum(np.arange(len(rows)) + frames, len(rows) - 1)]


def spans_to_export(file: Path) -> list[EpisodeSpan]:
    """Return the episodes of a recording that its operator did not discard.

    If the file cannot be read, return the whole recording as one episode.
    """
    try:
        return [span for span in read_spans(open_recording(file)) if not span.discarded]
    except RecordingError:
        return [WHOLE]  # Later, make_episode raises the error that says why.


# A function that writes an episode as a new file or folder. It is a module's function, so that other processes can
# import it.
Write = Callable[[EpisodeVectors, Path], None]
# A function that returns the number of each discarded episode of a file, and the reason. The second argument
# says whether the pictures are judged too. It is a module's function, too.
Verdicts = Callable[[Path, bool], Mapping[int, str]]
_LONGEST_REASON = 300  # The longest text of a reason [characters].


@dataclass(frozen=True, slots=True)
class _Job:
    """One episode to store; see :func:`keep_episodes`."""

    file: Path
    sampling: FrameSampling
    span: EpisodeSpan
    write: Write
    target: Path
    verdicts: Verdicts | None

    @property
    def name(self) -> str:
        """Return the path of the recording, followed by the number of the episode if it is not the whole recording."""
        return str(self.file) + (f" #{self.span.number}" if self.span.number else "")


@dataclass(frozen=True)
class Exported:
    """The result of :func:`keep_episodes`."""

    kept: list[Path]  # The files or folders of the stored episodes, in the order of their recordings.
    left_out: list[str]  # One line for each discarded episode, with the reasons.
    unreadable: list[str]  # One line for each recording that cannot be exported, with the reason.


def keep_episodes(
    files: Sequence[Path],
    sampling: FrameSampling,
    write: Write,
    folder: Path,
    *,
    place: JobPlace = HERE,
    verdicts: Verdicts | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> Exported:
    """Store each episode of some recordings in ``folder``. Episodes that are already in the folder are not made again.

    Recordings that cannot be read are left out.

    Args:
        files: The recordings.
        sampling: The rate of the frames, and what they contain.
        write: Writes one episode.
        folder: The folder for the episodes.
        place: The processes or machines that do the work. The result does not depend on it.
        verdicts: Returns the episodes to leave out; None to leave out none.
        progress: Called with the number of finished episodes.

    Returns:
        The paths of the stored episodes, and one line for each episode or recording that was left out.

    Raises:
        ConfigError: If nothing can be written, or if a worker process of this computer was killed.
    """
    jobs = [
        _Job(file, sampling, span, write, folder / _name(file, sampling, span, write, verdicts), verdicts)
        for file in files
        for span in spans_to_export(file)
    ]
    exported = Exported([], [], [])
    with closing(place.results(_keep, jobs, attrgetter("file"), folder)) as results:
        for done, (job, (verdict, fault)) in enumerate(zip(jobs, results, strict=True), start=1):
            if fault is not None:
                exported.unreadable.append(f"{job.name}: discard: unreadable, {fault}")
            elif verdict is not None:
                exported.left_out.append(f"{job.name}: {verdict}")
            else:
                exported.kept.append(job.target)
            progress(done)
    return exported


def _keep(job: _Job) -> tuple[str | None, str | None]:
    """Write one episode, unless it exists. An episode gets its name only when it is complete.

    Return two texts: the verdict if the episode is discarded, otherwise None; and the reason why the recording cannot
    be exported, or None if it can.
    """
    target = job.target
    if target.exists():
        return None, None
    try:
        discarded = {} if job.verdicts is None else job.verdicts(job.file, job.sampling.pictures)
        if (verdict := discarded.get(job.span.number)) is not None:
            return verdict, None
        episode = make_episode(job.file, job.sampling, job.span)
    except (RecordingError, *BROKEN) as error:
        return None, _reason(error, job)
    # The name contains machine and process. If a worker loses its scheduler, another machine gets the same episode, and
    # both may write it at the same time.
    unfinished = target.with_name(f"{target.name}.unfinished-{platform.node()}-{os.getpid()}")
    try:
        job.write(episode, unfinished)
        for path in (unfinished, *unfinished.rglob("*")):
            if path.is_file():
                with path.open("rb") as stream:
                    # Otherwise, a power failure could leave an incomplete episode under its final name.
                    os.fsync(stream.fileno())
        if not target.exists():
            unfinished.replace(target)
    except RecordingError as error:  # Pictures are read only while they are written, so this error can still occur.
        return None, _reason(error, job)
    except OSError as error:
        raise ConfigError(f"--output {target.parent}: {error.strerror or error}; {_OUTPUT}") from error
    return None, None


def _reason(error: Exception, job: _Job) -> str:
    return reason_of(error).removeprefix(f"{job.file}: ")[:_LONGEST_REASON]


def _name(file: Path, sampling: FrameSampling, span: EpisodeSpan, write: Write, verdicts: Verdicts | None) -> str:
    """Return the name under which an episode is stored. It depends on the recording and the settings of the export."""
    try:
        status = file.stat()
    except OSError as error:
        raise RecordingError(f"{file}: cannot be read: {error.strerror}") from error
    made_of = [str(file.resolve()), status.st_size, status.st_mtime_ns, asdict(sampling), span.number, verdicts is None]
    identity = json.dumps([*made_of, write.__module__, write.__name__, _FORMAT])
    key = hashlib.sha256(identity.encode()).hexdigest()[:24]
    return f"{file.stem}-{span.number}.{key}" if span.number else f"{file.stem}.{key}"


class Output:
    """The new folder OUT of an export. If an export is interrupted, its finished episodes stay in ``OUT.partial``.

    The next export uses them.

    Raises :class:`ConfigError` if the output exists or cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._refuse_existing()
        self._partial = path.with_name(f"{path.name}.partial")

    def episodes(self) -> Path:
        """Make the folder in which episodes are stored until the output is complete, and return its path."""
        folder = self._partial / "episodes"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--output {self._path}: {error.strerror}: {error.filename}; {_OUTPUT}") from error
        return folder

    def tidy(self) -> None:
        """Remove the folder of stored episodes if it is empty."""
        with suppress(OSError):
            (self._partial / "episodes").rmdir()
            self._partial.rmdir()

    def write(self, write: Callable[[Path], None]) -> None:
        """Let ``write`` make the folder under another name. When the folder is complete, rename it to OUT."""
        made = self._partial / "output"
        try:
            shutil.rmtree(made, ignore_errors=True)
            write(made)
            self._refuse_existing()
            made.rename(self._path)
            shutil.rmtree(self._partial)
        except OSError as error:
            raise ConfigError(f"--output {self._path}: {error.strerror or error}; {_OUTPUT}") from error

    def _refuse_existing(self) -> None:
        if self._path.exists() or self._path.is_symlink():
            raise ConfigError(f"--output {self._path}: exists; allowed: a name that does not exist yet")
