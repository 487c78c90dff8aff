"""Episodes: recordings as vectors at a fixed rate, made in several processes and kept until all are through."""

from __future__ import annotations

import hashlib
import json
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from q2r2_control.errors import ConfigError, RecordingError
from q2r2_control.export.features import Names, features
from q2r2_control.export.kept_pictures import KeptAs, KeptPictures, keep_pictures
from q2r2_control.export.ray_cluster import mapped_over
from q2r2_control.export.sampling import sample
from q2r2_control.recording.episode_spans import WHOLE, EpisodeSpan, read_spans
from q2r2_control.recording.recorded_robot import cell_and_robot_of
from q2r2_control.recording.ros_recording import open_recording

FASTEST = 1000  # [frames/s]
_FORMAT = 4  # of kept episodes; another one is made again


@dataclass(frozen=True)
class FrameSampling:
    """What becomes frames, and how many."""

    fps: int = 30
    trim: bool = False  # to the time in which arms are engaged or moving
    pictures: KeptAs | None = None  # None: they are left out

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
    cameras: dict[str, KeptPictures] = field(default_factory=dict)  # whose pictures are kept beside the episode
    success: bool | None = None  # None: nobody said
    part: int = 0  # which of the episodes in the file, from 1 on; 0: the whole

    @property
    def name(self) -> str:
        """Of the file, and which of several episodes in it."""
        return Path(self.recording).stem + (f"-{self.part}" if self.part else "")

    @property
    def frames(self) -> int:
        """Their number."""
        return len(next(iter(self.vectors.values())))

    def columns(self, index: int, first_frame: int, task: int) -> dict[str, npt.NDArray[Any]]:
        """All columns of a dataset in which this is episode ``index`` and ``first_frame`` frames are before it.

        Vectors are (n, size), the numbers of LeRobot's datasets behind them (n,).
        """
        frames = np.arange(self.frames)
        return {
            **self.vectors,
            "next.done": frames == self.frames - 1,
            "next.success": (frames == self.frames - 1) & bool(self.success),
            "timestamp": (frames / self.fps).astype(np.float32),
            "frame_index": frames,
            "episode_index": np.full(self.frames, index),
            "index": first_frame + frames,
            "task_index": np.full(self.frames, task),
        }

    def save(self, file: Path) -> None:
        """Keep it; a file of this name is always a whole one."""
        about = {name: value for name, value in self.__dict__.items() if name not in ("vectors", "cameras")}
        about["cameras"] = {name: asdict(kept) for name, kept in self.cameras.items()}
        unfinished = file.with_suffix(".unfinished")
        with unfinished.open("wb") as stream:
            np.savez(stream, about=np.array(json.dumps(about)), **self.vectors)  # type: ignore[arg-type]
        unfinished.replace(file)

    @classmethod
    def load(cls, file: Path) -> EpisodeVectors:
        """One that was kept."""
        with np.load(file) as kept:
            about = json.loads(str(kept["about"]))
            vectors = {name: kept[name] for name in about["names"]}
        about["names"] = {name: tuple(labels) for name, labels in about["names"].items()}
        about["cameras"] = {name: KeptPictures(**kept) for name, kept in about["cameras"].items()}
        return cls(**about, vectors=vectors)


@dataclass(frozen=True)
class EpisodePart:
    """An episode in a recording that has several; number 0: the whole."""

    number: int = 0  # from 1 on
    span: EpisodeSpan = WHOLE


def make_episode(
    file: Path, sampling: FrameSampling, target: Path | None = None, part: EpisodePart | None = None
) -> EpisodeVectors:
    """An episode of a recording, whose pictures go beside ``target``, if that is the file it will be kept in.

    Raises :class:`RecordingError` that names the file and what is wrong.
    """
    recording = open_recording(file)
    part = part or EpisodePart(0, replace(WHOLE, success=recording.conclusion.success))
    frames = sample(recording, sampling.fps, sampling.trim, part.span)
    cell, robot = cell_and_robot_of(recording)
    try:
        vectors, labels = features(frames, robot)
    except RecordingError as error:
        raise RecordingError(f"{recording.file}: {error}") from error
    notes = dict(recording.about.notes)
    task = notes.pop("task", "")
    cameras = {}
    if sampling.pictures is not None and target is not None:
        used = {name: cell.cameras[name] for name in recording.about.cameras}
        cameras = keep_pictures(recording, used, frames["stamp"].tolist(), sampling.fps, sampling.pictures, target)
    name = recording.file.name
    success = part.span.success
    return EpisodeVectors(name, cell.name, task, sampling.fps, labels, notes, vectors, cameras, success, part.number)


def parts_to_export(file: Path) -> list[EpisodePart]:
    """The episodes of a recording but those that its operator discarded; of a file that cannot be read the whole."""
    try:
        spans = read_spans(open_recording(file))
    except RecordingError:
        return [EpisodePart()]  # whoever makes an episode of it finds out
    if spans[0].whole:
        return [EpisodePart(0, spans[0])]
    return [EpisodePart(number, span) for number, span in enumerate(spans, 1) if not span.discarded]


@dataclass(frozen=True)
class Exported:
    """What became of recordings."""

    kept: list[Path]  # episodes, in the order of their recordings
    skipped: list[str]  # what was wrong with the others, a line each


def make_episodes(
    files: Sequence[Path],
    sampling: FrameSampling,
    folder: Path,
    *,
    workers: int = 1,
    ray: str | None = None,
    skip_bad: bool = False,
    progress: Callable[[int], None] = lambda done: None,
) -> Exported:
    """Make the episodes of recordings, and keep them in ``folder``; those that are there already are not made again.

    Those that an operator discarded while recording are left out. The same comes out for any number of ``workers``, and
    of a cluster at the address ``ray``. ``progress`` is told how many are through. Raises the :class:`RecordingError`
    of the first bad recording unless ``skip_bad``, and :class:`ConfigError` where nothing can be written.
    """
    parts = [(file, part) for file in files for part in parts_to_export(file)]
    targets = [folder / f"{_key(file, sampling, part)}.npz" for file, part in parts]
    jobs = [(file, sampling, target, part) for (file, part), target in zip(parts, targets, strict=True)]
    exported = Exported([], [])
    with _mapping(min(workers, len(jobs))) if ray is None else mapped_over(ray, _work) as run:
        for done, (target, fault) in enumerate(zip(targets, run(jobs), strict=True), start=1):
            if fault is not None and not skip_bad:
                raise RecordingError(fault)
            if fault is None:
                exported.kept.append(target)
            else:
                exported.skipped.append(fault)
            progress(done)
    return exported


@contextmanager
def _mapping(workers: int) -> Iterator[Callable[[list[Any]], Iterator[str | None]]]:
    """Faults of jobs in their order, done here or by processes."""
    if workers <= 1:
        yield lambda jobs: map(_work, jobs)
        return
    # Spawned, not forked: this process may have threads.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=signal.signal, initargs=_IGNORED)

    def run(jobs: list[Any]) -> Iterator[str | None]:
        try:
            return pool.map(_work, jobs)
        except OSError as error:  # "handle is closed", of a pool that breaks while it is given its jobs
            raise BrokenProcessPool from error

    try:
        yield run
    except BrokenProcessPool as error:
        raise ConfigError(
            "a process of --workers was killed, as for want of memory; the same command goes on with what is made"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


_IGNORED = (
    signal.SIGINT,
    signal.SIG_IGN,
)  # Ctrl-C goes to all of a terminal's processes; the first one ends the others


def _work(job: tuple[Path, FrameSampling, Path, EpisodePart]) -> str | None:
    """Make one episode unless it is there; returns what was wrong."""
    file, sampling, target, part = job
    if _is_kept(target):
        return None
    try:
        make_episode(file, sampling, target, part).save(target)
    except RecordingError as error:
        return str(error)
    except OSError as error:
        raise ConfigError(f"--output {target.parent}: {error.strerror}") from error
    return None


def _is_kept(target: Path) -> bool:
    try:
        EpisodeVectors.load(target)
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile):
        return False
    return True


def _key(file: Path, sampling: FrameSampling, part: EpisodePart) -> str:
    """Another one after any change of the recording or of what is asked for."""
    try:
        status = file.stat()
    except OSError as error:
        raise RecordingError(f"{file}: cannot be read: {error.strerror}") from error
    identity = [str(file.resolve()), status.st_size, status.st_mtime_ns, asdict(sampling), part.number, _FORMAT]
    return hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:24]
