"""Reads recordings, chunk by chunk: those that were ended, and what a killed process left."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Metadata, MetadataIndex, Schema
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from q2r2_control.errors import RecordingError
from q2r2_control.recording.about import ABOUT, CELL, CONCLUSION, CUT_OUT_OF, ROBOT, About, Conclusion
from q2r2_control.recording.rows import HEAD, MESSAGE, Rows, jpeg_of
from q2r2_control.recording.topics import PICTURE, Topic, picture

_LARGEST = 1 << 30  # of a record [bytes]
_OPCODE_AND_LENGTH = 9
_FOOTER_LENGTH = 20
_FOOTER = struct.Struct("<BQQQI8s")  # opcode, length, starts of summary and its offsets, checksum; then the magic
_BROKEN = (McapError, ZstdError, ValueError, KeyError, IndexError, struct.error, OverflowError, MemoryError)


@dataclass(frozen=True)
class RecordedChunk:
    """Messages of some ticks: rows of each topic, and the records of those that are texts."""

    rows: dict[str, Rows]
    texts: dict[str, list[bytes]]


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of a camera."""

    time: int  # of day, that of the tick at which all was where it shows it [ns]
    tick: int  # its number
    jpeg: bytes


class Recording:
    """A file that ``q2r2 run --record`` wrote. Raises :class:`RecordingError`, one line, for any other."""

    def __init__(self, path: Path) -> None:
        """``path``: the file, or the folder that it is alone in."""
        self.file = _file_of(path)
        self.about = self._read_about()
        if (whole := self.about.notes.get(CUT_OUT_OF)) is not None:
            raise RecordingError(f"{self.file}: one episode, cut out of {whole}; allowed: the recording that has all")
        self.topics = self.about.topics()
        self.since = 0  # time of day [ns]; what is known to be before it is left out
        self._cameras = {topic.channel for topic in self.topics.all if topic.type == PICTURE}

    def chunks(self) -> Iterator[RecordedChunk]:
        """All messages but pictures, some half a second at a time."""
        with self._faults():
            for data in self._chunk_data():
                yield self._split(data)

    def pictures(self, camera: str) -> Iterator[Picture]:
        """All pictures of a camera, in the order of time."""
        channel = self.topics.by_name[picture(camera)].channel
        with self._faults():
            for data in self._chunk_data():
                for found, at, end in messages_in(data):
                    if found == channel:
                        _, _, _, tick, time, _ = HEAD.unpack_from(data, at)
                        yield Picture(time, tick, jpeg_of(data[at:end]))

    @cached_property
    def declared_topics(self) -> dict[int, Topic]:
        """All topics that are in the file, by channel; none before its first messages."""
        types: dict[int, str] = {}
        found: dict[int, Topic] = {}
        with self._faults():
            chunk = next((record for record in self._records() if isinstance(record, Chunk)), None)
            for record in breakup_chunk(chunk, validate_crc=True) if chunk is not None else ():
                if isinstance(record, Schema):
                    types[record.id] = record.name
                elif isinstance(record, Channel):
                    found[record.id] = Topic(record.id, record.topic, types[record.schema_id])
        return found

    def messages(self) -> Iterator[list[bytes]]:
        """The records of all messages as they are, chunk by chunk."""
        with self._faults():
            for data in self._chunk_data():
                yield [data[at:end] for _, at, end in messages_in(data)]

    @contextmanager
    def _faults(self) -> Iterator[None]:
        """What is wrong with a file, as one line."""
        try:
            yield
        except EndOfFile:
            return  # cut off in the middle of a record, by a machine that lost its power
        except _BROKEN as error:
            raise RecordingError(f"{self.file}: damaged: {_line(error)}") from error

    def _chunk_data(self) -> Iterator[bytes]:
        """The messages of each chunk."""
        self._check_topics()
        for record in self._records():
            if isinstance(record, Chunk) and record.message_end_time >= self.since:
                stream, size = get_chunk_data_stream(record, validate_crc=True)
                yield stream.read(size)
            elif isinstance(record, DataEnd):
                return

    @property
    def closed(self) -> bool:
        """Whether the file has an index, which is written last: not where its process was killed or the disk full."""
        return self._index_start() > 0

    @property
    def conclusion(self) -> Conclusion:
        """What was said at the end of the run; nothing where the file has no index."""
        start = self._index_start()
        if not start:
            return Conclusion()
        with self._faults():
            for record in self._records(start):
                if isinstance(record, MetadataIndex) and record.name == CONCLUSION:
                    metadata = next(self._records(record.offset), None)
                    if isinstance(metadata, Metadata):
                        return Conclusion.from_texts(metadata.metadata)
        return Conclusion()

    def _index_start(self) -> int:
        """Where the index begins in the file; 0: there is none."""
        try:
            with self.file.open("rb") as stream:
                stream.seek(max(self.file.stat().st_size - _FOOTER.size, 0))
                end = stream.read()
        except OSError as error:
            raise RecordingError(f"{self.file}: cannot be read: {error.strerror}") from error
        if len(end) != _FOOTER.size:
            return 0
        opcode, length, summary, _, _, magic = _FOOTER.unpack(end)
        return int(summary) if opcode == Opcode.FOOTER and length == _FOOTER_LENGTH and magic == MCAP0_MAGIC else 0

    def _records(self, start: int = 0) -> Iterator[McapRecord]:
        """All from the beginning, or from a record that starts at ``start``."""
        try:
            with self.file.open("rb") as stream:
                stream.seek(start)
                # Not wrapped, so that a file that changes meanwhile is not read twice.
                reader = StreamReader(stream, start > 0, emit_chunks=True, record_size_limit=_LARGEST)
                yield from reader.records
        except OSError as error:
            raise RecordingError(f"{self.file}: cannot be read: {error.strerror}") from error

    def _read_about(self) -> About:
        texts: dict[str, str] = {}
        attachments: dict[str, str] = {}
        try:
            for record in self._records():
                if isinstance(record, Metadata) and record.name == ABOUT:
                    texts = record.metadata
                elif isinstance(record, Attachment):
                    attachments[record.name] = record.data.decode()
                elif isinstance(record, Chunk):
                    break
        except EndOfFile:
            pass
        except _BROKEN as error:
            raise RecordingError(f"{self.file}: not an MCAP file, or damaged: {_line(error)}") from error
        if not texts:
            raise RecordingError(f"{self.file}: not a recording of q2r2 run --record: no metadata {ABOUT}")
        try:
            return About.from_texts(texts, attachments[CELL], attachments[ROBOT])
        except KeyError as error:
            raise RecordingError(f"{self.file}: damaged: no {error.args[0]}") from error
        except ValueError as error:
            raise RecordingError(f"{self.file}: {_line(error)}") from error

    def _check_topics(self) -> None:
        for topic in self.declared_topics.values():
            known = self.topics.by_channel.get(topic.channel)
            if known is None or known.name != topic.name:
                raise ValueError(f"unknown topic {topic.name}")

    def _split(self, data: bytes) -> RecordedChunk:
        """The messages of a chunk by topic."""
        records: dict[int, list[bytes]] = {}
        for channel, at, end in messages_in(data):
            if channel not in self._cameras:
                records.setdefault(channel, []).append(data[at:end])
        rows, texts = {}, {}
        for channel, found in records.items():
            topic = self.topics.by_channel[channel]
            if topic.row is None:
                texts[topic.name] = found
            else:
                rows[topic.name] = _as_rows(topic, found)
        return RecordedChunk(rows, texts)


def messages_in(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Channel, begin and end of each message of a chunk."""
    at = 0
    while at < len(data):
        opcode, length, channel, *_ = HEAD.unpack_from(data, at)
        end = at + _OPCODE_AND_LENGTH + length
        if end > len(data):
            raise ValueError("a chunk that does not end with a message")
        if opcode == MESSAGE:  # and not the schema or the channel of one
            yield channel, at, end
        at = end


def _as_rows(topic: Topic, records: list[bytes]) -> Rows:
    assert topic.row is not None
    dtype = topic.row.dtype
    if any(len(record) != dtype.itemsize for record in records):
        raise ValueError(f"a message of {topic.name} has a size that it cannot have")
    return np.frombuffer(b"".join(records), dtype=dtype)


def _file_of(path: Path) -> Path:
    if not path.is_dir():
        if not path.exists():
            raise RecordingError(f"{path}: no such file or folder")
        return path
    files = sorted(path.glob("*.mcap"))
    if len(files) != 1:
        raise RecordingError(f"{path}: has {len(files)} files .mcap; allowed: a folder with one, or a file")
    return files[0]


def _line(error: Exception) -> str:
    return " ".join((str(error) or repr(error)).split())[:200]
