"""Reads MCAP files of any writer: wherever its chunks end, whatever stands between them, and wherever the file is cut.

The package ``mcap`` reads records. It reads no file whose end is missing, so a walk over the records finds them here.
Its rules are in https://mcap.dev/spec.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, McapRecord, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from q2r2_control.recording.messages import Message, Topic

_LARGEST = 1 << 30  # of a record [bytes]
_BATCH = 1000  # number of messages that are read together from a file without chunks
_HEADER = struct.Struct("<BQ")  # kind and length of a record, before its content
_CHUNK_TIMES = struct.Struct("<QQ")  # of a chunk's first and last message [ns], where its content begins


class _Place(NamedTuple):
    """Where a record is in the file, and the beginning of its content."""

    kind: int
    begin: int  # [bytes]
    head: bytes

    @property
    def times(self) -> tuple[int, int]:
        """Times of the first and the last message of a chunk [ns]."""
        first, last = _CHUNK_TIMES.unpack_from(self.head)
        return first, last


class McapFile:
    """One file, which another process may be writing: what is written while it is read is left out."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._types: dict[int, str] = {}  # by schema
        self._topics: dict[int, Topic] = {}  # by channel
        self._skipped: list[_Place] = []  # chunks that may declare channels

    def topics(self) -> dict[int, Topic]:
        """All topics that the file declares anywhere, by channel."""
        with self._path.open("rb") as stream:
            for place in _places(stream):
                if place.kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK):
                    self._declare_all(stream, place)
        return dict(self._topics)

    def topic(self, channel: int) -> str:
        """The topic of a message that was read."""
        return self._topics[channel].name

    def extras(self) -> Iterator[Metadata | Attachment]:
        """All metadata and attachments, in the order of the file."""
        with self._path.open("rb") as stream:
            for place in _places(stream):
                if place.kind in (Opcode.METADATA, Opcode.ATTACHMENT):
                    record = _record(stream, place)
                    assert isinstance(record, Metadata | Attachment)
                    yield record

    def summary(self) -> Summary | None:
        """The index, which is written last; None where there is none or it is damaged. Raises :class:`OSError`."""
        with self._path.open("rb") as stream:
            try:
                return SeekingReader(stream, record_size_limit=_LARGEST).get_summary()
            except (StopIteration, McapError, ValueError, KeyError, struct.error, OverflowError, MemoryError):
                return None

    def messages(self, topics: Collection[str] | None = None, since: int = 0) -> Iterator[list[Message]]:
        """All messages, or those of some ``topics``, a chunk or some hundred at once.

        They come in the order of the file, which ``mcap sort`` makes that of time. Chunks that end before ``since``
        [ns] are left out. Raises what the package ``mcap`` raises of a damaged file.
        """
        with self._path.open("rb") as stream:
            yield from self._in_file_order(stream, topics, since)

    def _in_file_order(self, stream: BinaryIO, topics: Collection[str] | None, since: int) -> Iterator[list[Message]]:
        loose: list[Message] = []  # those that no chunk has
        for place in _places(stream):
            if place.kind == Opcode.CHUNK and place.times[1] < since:
                self._skipped.append(place)
            elif place.kind == Opcode.CHUNK:
                chunk = _record(stream, place)
                assert isinstance(chunk, Chunk)
                records = breakup_chunk(chunk, validate_crc=True)
                yield [*loose, *self._wanted(stream, records, topics)]
                loose = []
            elif place.kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                loose += self._wanted(stream, [_record(stream, place)], topics)
                if len(loose) >= _BATCH:
                    yield loose
                    loose = []
        if loose:
            yield loose

    def _wanted(self, stream: BinaryIO, records: list[McapRecord], topics: Collection[str] | None) -> Iterator[Message]:
        """The messages of ``topics`` among some records, whose channels become known."""
        channels: dict[int, bool] = {}  # True for those of the topics
        for one in records:
            if isinstance(one, McapMessage):
                channel = one.channel_id
                if (wanted := channels.get(channel)) is None:
                    while channel not in self._topics and self._skipped:
                        self._declare_all(stream, self._skipped.pop())
                    wanted = channels[channel] = topics is None or self._topics[channel].name in topics
                if wanted:
                    yield Message(channel, one.sequence, one.log_time, one.publish_time, one.data)
            else:
                self._declare(one)

    def _declare_all(self, stream: BinaryIO, place: _Place) -> None:
        record = _record(stream, place)
        for one in breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]:
            self._declare(one)

    def _declare(self, record: McapRecord) -> None:
        if isinstance(record, Schema):
            self._types[record.id] = record.name
        elif isinstance(record, Channel):
            self._topics[record.id] = Topic(record.id, record.topic, self._types.get(record.schema_id, ""))


def _places(stream: BinaryIO) -> Iterator[_Place]:
    """Where each record is, up to the end of the data, or of the last whole record of a file that nobody ended.

    Raises :class:`InvalidMagic` for another program's file, and :class:`EndOfFile` for a record that is longer than a
    file that was ended.
    """
    file, size = stream.fileno(), os.fstat(stream.fileno()).st_size
    magic = os.pread(file, len(MCAP0_MAGIC), 0)
    if not MCAP0_MAGIC.startswith(magic):
        raise InvalidMagic(magic)
    place, room = len(MCAP0_MAGIC), _HEADER.size + _CHUNK_TIMES.size
    ended = size > place and os.pread(file, len(MCAP0_MAGIC), size - len(MCAP0_MAGIC)) == MCAP0_MAGIC
    while place + _HEADER.size <= size:
        head = os.pread(file, room, place)
        kind, length = _HEADER.unpack_from(head)
        end = place + _HEADER.size + length
        if end > size and not ended:
            return
        if end > size:
            raise EndOfFile
        if kind in (Opcode.DATA_END, Opcode.FOOTER):
            return
        yield _Place(kind, place, head[_HEADER.size :])
        place = end


def _record(stream: BinaryIO, place: _Place) -> McapRecord:
    stream.seek(place.begin)
    return next(StreamReader(stream, skip_magic=True, emit_chunks=True, record_size_limit=_LARGEST).records)
