"""Reads MCAP files of any writer, also files whose end is missing.

The package ``mcap`` decodes the records, but cannot find them in a file whose end is missing. Therefore this module
goes through the file from record to record. The rules of the format are in https://mcap.dev/spec.
"""

from __future__ import annotations

import errno
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

_LARGEST = 1 << 30  # The largest size of a record [bytes].
_BATCH = 1000  # The number of messages in a list, if the messages are not in chunks.
_HEADER = struct.Struct("<BQ")  # The kind and the length of a record, before its content.
_CHUNK_TIMES = struct.Struct("<QQ")  # Times of a chunk's first and last message [ns], at the start of its content.


class _Place(NamedTuple):
    """The position of a record in the file, and the first bytes of its content."""

    kind: int  # The opcode of the record.
    begin: int  # The position of the record in the file [bytes].
    head: bytes  # The first bytes of the content, at most 16.

    @property
    def times(self) -> tuple[int, int]:
        """Times of the first and the last message [ns], if the record is a chunk."""
        first, last = _CHUNK_TIMES.unpack_from(self.head)
        return first, last


class McapFile:
    """One MCAP file. Another process may still be writing it; records that are added during reading are left out."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._types: dict[int, str] = {}  # Message types. The keys are the ids of schemas.
        self._topics: dict[int, Topic] = {}  # Topics. The keys are the ids of channels.
        self._skipped: list[_Place] = []  # Chunks that were not read and may declare channels.

    def topics(self) -> dict[int, Topic]:
        """Return all topics that the file declares anywhere, by channel."""
        with self._path.open("rb") as stream:
            for place in _places(stream):
                if place.kind in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK):
                    self._declare_all(stream, place)
        return dict(self._topics)

    def topic(self, channel: int) -> str:
        """Return the topic of a message that was read, by the message's channel."""
        return self._topics[channel].name

    def extras(self) -> Iterator[Metadata | Attachment]:
        """Yield all metadata and attachments, in the order of the file."""
        with self._path.open("rb") as stream:
            for place in _places(stream):
                if place.kind in (Opcode.METADATA, Opcode.ATTACHMENT):
                    record = _record(stream, place)
                    assert isinstance(record, Metadata | Attachment)
                    yield record

    def summary(self) -> Summary | None:
        """Return the index, which is written last; None if it is missing or damaged. Raises :class:`OSError`."""
        with self._path.open("rb") as stream:
            try:
                return SeekingReader(stream, record_size_limit=_LARGEST).get_summary()
            except (StopIteration, McapError, ValueError, KeyError, struct.error, OverflowError, MemoryError):
                return None
            except OSError as error:
                if error.errno != errno.EINVAL:
                    raise
                return None  # The last bytes of an unfinished file may look like an index at an impossible position.

    def messages(self, topics: Collection[str] | None = None, since: int = 0) -> Iterator[list[Message]]:
        """Yield all messages, or those of some ``topics``, in lists.

        A list has the messages of one chunk, or about a thousand messages that are in no chunk. Messages come in the
        order in which they are in the file. In files of ``mcap sort``, this is the order of time. Chunks that end
        before ``since`` [ns] are left out. Raises the errors of the package ``mcap`` for a damaged file.
        """
        with self._path.open("rb") as stream:
            yield from self._in_file_order(stream, topics, since)

    def _in_file_order(self, stream: BinaryIO, topics: Collection[str] | None, since: int) -> Iterator[list[Message]]:
        loose: list[Message] = []  # Messages that are in no chunk.
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
        """Yield the messages of ``records`` that belong to ``topics``; None stands for all topics.

        Channels that the records declare are stored.
        """
        channels: dict[int, bool] = {}  # True for each channel whose topic is among ``topics``.
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
    """Yield the place of each record up to the end of the data.

    In an unfinished file, the last record is left out if it is not complete.

    Raises :class:`InvalidMagic` for a file that is not MCAP, and :class:`EndOfFile` if a finished file ends inside a
    record.
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
