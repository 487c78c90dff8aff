"""Reads recordings chunk by chunk, and the episodes that an operator marked in them.

A recording whose process was killed can be read too.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.records import Attachment, Metadata
from mcap.summary import Summary
from rosbags.serde import SerdeError
from zstandard import ZstdError

from q2r2_control.errors import RecordingError
from q2r2_control.events import Event
from q2r2_control.process.helper_process import reason_of
from q2r2_control.recording.about import ABOUT, CELL, CONCLUSION, LOOP, ROBOT, About, Conclusion
from q2r2_control.recording.mcap_file import McapFile
from q2r2_control.recording.messages import (
    PICTURE,
    STATE,
    TEXT,
    Message,
    Topic,
    data_of,
    depth_topic,
    picture_topic,
    unit_of_depth,
)
from q2r2_control.recording.recorded_reasons import event_of
from q2r2_control.recording.tick_chunks import TickAssembly, TickChunk
from q2r2_control.teleop.reasons import TeleopReason

# The errors of the packages that read a file, if the file is damaged or was written by another program.
BROKEN = (
    *(McapError, ZstdError, SerdeError, ValueError, KeyError, IndexError),
    *(struct.error, TypeError, OverflowError, MemoryError, AssertionError),
)


@dataclass(frozen=True, slots=True)
class Picture:
    # The Unix time at which the picture was captured, or was received if a ROS node sent it [ns].
    time: int
    tick: int  # The number of the newest tick at ``time``. In a recording of ROS nodes, it is a sequence number.
    jpeg: bytes  # The picture as a JPEG file; a picture of depth is a PNG file with 16 bits for each pixel.


NO_END = "the recording has no end: its process was killed, or the disk was full"


class Recording:
    """A recording that ``q2r2 run --record`` wrote.

    If the file is not such a recording, :class:`RecordingError` is raised, with a message of one line.
    """

    def __init__(self, path: Path) -> None:
        """Open ``path``: the file, or a folder in which it is the only recording."""
        files = recordings_in([path])
        if len(files) != 1:
            raise RecordingError(f"{path}: has {len(files)} files .mcap; allowed: a folder with one, or a file")
        self.file = files[0]
        self._mcap = McapFile(self.file)
        self.about = self._read_about()
        self.since = 0  # Chunks of the file that end before this Unix time are left out [ns].

    def chunks(self) -> Iterator[TickChunk]:
        """Yield all ticks, in groups that follow each other. Ticks that were lost are missing."""
        ticks = TickAssembly(len(self.about.arms), len(self.about.joints))
        try:
            for messages in self.messages(ticks.topics):
                ticks.add((self.topic(message), message) for message in messages)
                with self._faults():
                    yield from ticks.whole()
        except RecordingError:
            with suppress(*BROKEN):
                yield from ticks.rest(ended=False)
            raise
        with self._faults():
            yield from ticks.rest(self.closed)

    def pictures(self, camera: str) -> Iterator[Picture]:
        """Return all pictures of a camera, in the order of time."""
        return (picture for _, picture in self.pictures_of((camera,)))

    def pictures_of(self, cameras: Iterable[str]) -> Iterator[tuple[str, Picture]]:
        """Return all pictures of some cameras, each with the name of its camera.

        The pictures of each camera are in the order of time.
        """
        return self._coded({self._topic_of(camera): camera for camera in cameras})

    def depths(self, camera: str) -> Iterator[Picture]:
        """Return all depth pictures of a camera, in the order of time."""
        return (picture for _, picture in self._coded({depth_topic(camera): camera}))

    def depth_unit(self, camera: str) -> float:
        """Return the unit of the numbers in a camera's depth pictures [m].

        Raises :class:`RecordingError` if no depth was recorded.
        """
        for messages in self.messages((depth_topic(camera),)):
            for message in messages:
                with self._faults():
                    return unit_of_depth(message.payload)
        raise RecordingError(f"{self.file}: depth of camera {camera}: no picture was recorded")

    def _coded(self, names: Mapping[str, str]) -> Iterator[tuple[str, Picture]]:
        """Yield all pictures on the topics in ``names``. ``names`` maps a topic to the name that is yielded."""
        for messages in self.messages(names):
            for message in messages:
                with self._faults():
                    picture = Picture(self._time_of(message), message.number, bytes(data_of(message.payload, PICTURE)))
                yield names[self.topic(message)], picture

    def _topic_of(self, camera: str) -> str:
        return picture_topic(camera)

    def _time_of(self, picture: Message) -> int:
        """Return the Unix time at which a picture was captured [ns]."""
        return picture.time

    @cached_property
    def declared_topics(self) -> dict[int, Topic]:
        """Return all topics that the file declares, by channel."""
        with self._faults():
            return self._mcap.topics()

    def messages(self, topics: Collection[str] | None = None) -> Iterator[list[Message]]:
        """Yield all messages, or those of some ``topics``, as lists of several messages."""
        with self._faults():
            yield from self._mcap.messages(topics, self.since)

    def topic(self, message: Message) -> str:
        """Return the name of the topic of a message that was read."""
        return self._mcap.topic(message.channel)

    @contextmanager
    def _faults(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RecordingError(f"{self.file}: cannot be read: {error.strerror}") from error
        except EndOfFile as error:
            raise RecordingError(f"{self.file}: damaged: a record is longer than what has it") from error
        except BROKEN as error:
            raise RecordingError(f"{self.file}: damaged: {reason_of(error):.200}") from error

    @property
    def closed(self) -> bool:
        """Return whether the file has an index.

        The index is written last. It is missing if the process was killed, or if the disk was full.
        """
        return self._summary() is not None

    @property
    def counts(self) -> dict[str, int] | None:
        """Return the number of messages of each topic; None if the file has no index."""
        summary = self._summary()
        if summary is None or summary.statistics is None:
            return None
        counts, channels = summary.statistics.channel_message_counts, summary.channels.values()
        return {channel.topic: counts.get(channel.id, 0) for channel in channels}

    @property
    def conclusion(self) -> Conclusion:
        """Return the facts that the run stated at its end. All facts are None if the file has no index."""
        if self.closed:
            with self._faults():
                for record in self._mcap.extras():
                    if isinstance(record, Metadata) and record.name == CONCLUSION:
                        return Conclusion.from_texts(record.metadata)
        return Conclusion()

    def _summary(self) -> Summary | None:
        try:
            return self._mcap.summary()
        except OSError as error:
            raise RecordingError(f"{self.file}: cannot be read: {error.strerror}") from error

    def _read_about(self) -> About:
        texts: dict[str, str] = {}
        attachments: dict[str, str] = {}
        try:
            for record in self._mcap.extras():
                if isinstance(record, Attachment):
                    attachments[record.name] = record.data.decode()
                elif record.name == ABOUT:
                    texts = record.metadata
                if texts and {CELL, ROBOT} <= attachments.keys():
                    break
        except OSError as error:
            raise RecordingError(f"{self.file}: cannot be read: {error.strerror}") from error
        except InvalidMagic as error:
            raise RecordingError(f"{self.file}: not an MCAP file; allowed: a recording of q2r2 run --record") from error
        except BROKEN as error:
            raise RecordingError(f"{self.file}: damaged: {reason_of(error):.200}") from error
        if not self.file.stat().st_size:
            raise RecordingError(f"{self.file}: the file is empty; allowed: a recording of q2r2 run --record")
        if not texts:
            raise RecordingError(f"{self.file}: not a recording of q2r2 run --record: no metadata {ABOUT}")
        try:
            return About.from_texts(texts, attachments[CELL], attachments[ROBOT])
        except KeyError as error:
            what = "damaged: no" if self.closed else "its process was killed before it had written"
            raise RecordingError(f"{self.file}: {what} {error.args[0]}") from error
        except ValueError as error:
            raise RecordingError(f"{self.file}: {reason_of(error):.200}") from error


def recordings_in(paths: Sequence[Path]) -> list[Path]:
    """Return the paths of the recordings in some files and folders.

    Args:
        paths: Files, and folders in which recordings are looked for at any depth.

    Returns:
        The given files and the recordings in the folders, each once. The recordings of one folder are sorted by path.

    Raises:
        RecordingError: If a path does not exist, or if a folder has no recording.
    """
    files: dict[Path, Path] = {}
    for path in paths:
        if path.is_dir():
            found = sorted(path.rglob("*.mcap"))
            if not found:
                raise RecordingError(f"{path}: no file .mcap in it; allowed: recordings of q2r2 run --record")
        elif path.exists():
            found = [path]
        else:
            raise RecordingError(f"{path}: no such file or folder")
        for file in found:
            files.setdefault(file.resolve(), file)
    return list(files.values())


@dataclass(frozen=True)
class EpisodeSpan:
    """The time span of an episode within a run, with the operator's marks. Times count from the run's start [s]."""

    start: float = -math.inf
    end: float = math.inf  # inf stands for the end of the run.
    discarded: bool = False  # True if the operator discarded the episode.
    success: bool | None = None  # True if the episode succeeded; None if that is not known.
    number: int = 0  # The number of the episode, from 1 on; 0 is the whole run.
    # Times at which the operator began another subtask [s]. The first subtask begins with the episode.
    subtask_starts: tuple[float, ...] = ()

    def with_subtask(self, start: float) -> EpisodeSpan:
        """Return the episode with one more subtask, which begins at ``start`` [s]."""
        return replace(self, subtask_starts=(*self.subtask_starts, start))


WHOLE = EpisodeSpan()


def spans_of(events: Iterable[Event], run_succeeded: bool | None = None) -> list[EpisodeSpan]:
    """Return the episodes that an operator has marked, or the whole run if the operator marked none.

    The operator can discard an episode, or mark it as a success or failure. Such a mark belongs to the episode that is
    going on. If no episode is going on, it belongs to the last episode. The last mark counts if an episode has both a
    success and a failure. The whole run has the success that the operator marked. Without such a mark, it has
    ``run_succeeded``, which is the result of the task's own check.
    """
    whole = replace(WHOLE, success=run_succeeded)
    spans: list[EpisodeSpan] = []
    for event in events:
        is_open = bool(spans) and spans[-1].end == math.inf
        if event.kind is TeleopReason.EPISODE_BEGINS and not is_open:
            spans.append(EpisodeSpan(event.t))
        elif event.kind is TeleopReason.EPISODE_ENDS and is_open:
            spans[-1] = replace(spans[-1], end=event.t)
        elif event.kind is TeleopReason.SUBTASK_BEGINS and is_open:
            spans[-1] = spans[-1].with_subtask(event.t)
        elif event.kind is TeleopReason.SUBTASK_BEGINS and not spans:
            whole = whole.with_subtask(event.t)
        elif event.kind is TeleopReason.EPISODE_DISCARDED and spans:
            spans[-1] = replace(spans[-1], end=min(spans[-1].end, event.t), discarded=True)
        elif event.kind in (TeleopReason.EPISODE_SUCCEEDED, TeleopReason.EPISODE_FAILED):
            success = event.kind is TeleopReason.EPISODE_SUCCEEDED
            if spans:
                spans[-1] = replace(spans[-1], end=min(spans[-1].end, event.t), success=success)
            else:
                whole = replace(whole, success=success)
    return [replace(span, number=number) for number, span in enumerate(spans, 1)] or [whole]


def read_spans(recording: Recording) -> list[EpisodeSpan]:
    """Return the episodes of a recording. Raises :class:`RecordingError` if it is damaged."""
    return spans_of(read_events(recording), recording.conclusion.success)


def read_events(recording: Recording) -> list[Event]:
    """Return all events of a recording. Raises :class:`RecordingError` if it is damaged."""
    try:
        return list(_events_of(recording))
    except (ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{recording.file}: damaged: {error!r:.200}") from error


def _events_of(recording: Recording) -> Iterator[Event]:
    """Yield all events of a recording.

    In a loop's recording, one topic has all events, so the larger messages with the numbers of ticks are not read.
    """
    if recording.about.source == LOOP:
        states = (str(data_of(one.payload, TEXT)) for messages in recording.messages({STATE}) for one in messages)
        for state in states:
            yield from map(event_of, json.loads(state).get("events", ()))
        return
    for chunk in recording.chunks():
        for events in chunk.events().values():
            yield from events
