"""An MCAP file (https://mcap.dev/spec) that is whole after every chunk: ends with a footer, which the next overwrites.

So what a killed process leaves behind is a file without an index, which every reader opens; the index and statistics
are written when it is closed. The writers of the packages ``mcap`` and ``rosbags`` keep up to a megabyte to themselves,
write the footer at the end only, and take each message by itself, which would keep a processor busy that the loop may
need. Here a message is a row of bytes already; the records around chunks are those of ``mcap``.
"""

from __future__ import annotations

import os
import struct
import zlib
from array import array
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from q2r2_control.recording.rows import log_time
from q2r2_control.recording.topics import Topic

MAGIC = b"\x89MCAP0\r\n"
_LIBRARY = "q2r2_control"
_FASTEST = 1  # of zstd's levels


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


_RECORD_HEAD = 9  # opcode and length [bytes]
_SKIPPED = 0x80  # the first opcode that the format leaves to applications
_END = _bytes_of(DataEnd(0), Footer(summary_start=0, summary_offset_start=0, summary_crc=0)) + MAGIC


class _Messages:
    """Those of one chunk."""

    def __init__(self) -> None:
        self.records: list[bytes] = []
        self.index: dict[int, array[int]] = {}  # time and offset of each, by channel
        self.first = self.last = 0  # [ns]
        self.size = 0  # [bytes]

    def add(self, messages: Iterable[tuple[Topic, bytes]]) -> None:
        for topic, record in messages:
            entries = self.index.get(topic.channel)
            if entries is None:
                entries = self.index[topic.channel] = array("Q")
            time = log_time(record)
            entries.append(time)
            entries.append(self.size)
            self.first = time if not self.size else self.first
            self.last = time
            self.records.append(record)
            self.size += len(record)
        self.records = [b"".join(self.records)]


class McapFile:
    """Writes one file; every method raises :class:`OSError` where that is not possible, and then leaves a whole file.

    Not for several threads.
    """

    def __init__(self, path: Path) -> None:
        """Create ``path``. Raises :class:`FileExistsError` where it exists."""
        self._fd = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        self._compressor = zstandard.ZstdCompressor(level=_FASTEST)
        self._end = 0
        self._head = MAGIC + _bytes_of(Header(profile="ros2", library=_LIBRARY))
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks = 0
        self._chunk_index = bytearray()  # their records, kept as bytes, since there are some for every second
        self._waiting = _Messages()  # added and not written
        self.counts: dict[int, int] = {}  # messages of each channel
        self.first_time, self.last_time = 0, 0  # of messages [ns]

    def add_topics(self, topics: Iterable[Topic], definitions: Mapping[str, str], qos: str) -> None:
        """Declare topics before :meth:`begin`, with the definitions of their types in the format of ROS 2."""
        numbers = {name: number for number, name in enumerate(definitions, 1)}
        self._schemas = [Schema(numbers[name], text.encode(), "ros2msg", name) for name, text in definitions.items()]
        metadata = {"offered_qos_profiles": qos}
        self._channels = [Channel(topic.channel, topic.name, "cdr", metadata, numbers[topic.type]) for topic in topics]
        self.counts = {channel.id: 0 for channel in self._channels}
        self._head += _bytes_of(*self._schemas, *self._channels)

    def add_attachment(self, name: str, media_type: str, text: str, time: int) -> None:
        """Keep a text in the file, before :meth:`begin`; ``time`` [ns] of day."""
        data = text.encode()
        record = _bytes_of(Attachment(time, time, name, media_type, data))
        index = AttachmentIndex(len(self._head), len(record), time, time, len(data), name, media_type)
        self._attachments.append(index)
        self._head += record

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Keep named texts in the file, at its beginning or, after :meth:`begin`, behind what was written."""
        record = _bytes_of(Metadata(name, dict(values)))
        place = self._end or len(self._head)
        if self._end:
            self._append(record)
        else:
            self._head += record
        self._metadata.append(MetadataIndex(place, len(record), name))

    def begin(self) -> None:
        """Write all that was added."""
        self._append(self._head)

    def add(self, messages: Iterable[tuple[Topic, bytes]]) -> None:
        """Take messages, each a whole record, in order of time; :meth:`flush` writes them."""
        self._waiting.add(messages)

    @property
    def pending(self) -> int:
        """Bytes that were added and are not written."""
        return self._waiting.size

    def flush(self) -> None:
        """Write what was added, as one chunk."""
        if self._waiting.size:
            messages, self._waiting = self._waiting, _Messages()
            self._write_chunk(messages, "zstd")

    def add_apart(self, messages: Iterable[tuple[Topic, bytes]]) -> None:
        """Write messages that are compressed already, in order of time, as a chunk of their own."""
        chunk = _Messages()
        chunk.add(messages)
        self._write_chunk(chunk, "")

    def _write_chunk(self, messages: _Messages, compression: str) -> None:
        data = b"".join(messages.records)
        first, last, size = messages.first, messages.last, messages.size
        packed = self._compressor.compress(data) if compression else data
        chunk = _bytes_of(Chunk(compression, packed, last, first, zlib.crc32(data), size))
        offsets, indices = {}, b""
        for channel, entries in messages.index.items():
            offsets[channel] = self._end + len(chunk) + len(indices)
            table = entries.tobytes()
            indices += struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + len(table), channel, len(table)) + table
        begin = self._end
        self._append(chunk + indices)
        self._chunk_index += _bytes_of(
            ChunkIndex(len(chunk), begin, compression, len(packed), last, len(indices), offsets, first, size)
        )
        self.first_time = first if not self._chunks else min(first, self.first_time)
        self.last_time = max(last, self.last_time)
        self._chunks += 1
        for channel, entries in messages.index.items():
            self.counts[channel] += len(entries) // 2

    def close(self) -> None:
        """Write the index and statistics, and close; the file stays whole where they cannot be written."""
        try:
            if self._end:
                data_end = _bytes_of(DataEnd(0))
                self._append(data_end + self._summary(self._end + len(data_end)), end=b"")
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close as it is, without index."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _summary(self, start: int) -> bytes:
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts={channel: count for channel, count in self.counts.items() if count},
            chunk_count=self._chunks,
            message_count=sum(self.counts.values()),
            message_end_time=self.last_time,
            message_start_time=self.first_time,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups = (
            (Opcode.SCHEMA, _bytes_of(*self._schemas)),
            (Opcode.CHANNEL, _bytes_of(*self._channels)),
            (Opcode.STATISTICS, _bytes_of(statistics)),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_index)),
            (Opcode.ATTACHMENT_INDEX, _bytes_of(*self._attachments)),
            (Opcode.METADATA_INDEX, _bytes_of(*self._metadata)),
        )
        summary, offsets = b"", []
        for opcode, data in groups:
            if data:
                offsets.append(SummaryOffset(opcode, len(data), start + len(summary)))
                summary += data
        offset_start = start + len(summary)
        summary += _bytes_of(*offsets)
        # The checksum covers the footer up to itself.
        crc = zlib.crc32(struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start), zlib.crc32(summary))
        footer = Footer(summary_start=start, summary_offset_start=offset_start, summary_crc=crc)
        return summary + _bytes_of(footer) + MAGIC

    def _append(self, data: bytes, end: bytes = _END) -> None:
        """Write over the last end, with a new one behind, so that the file is whole while that goes on, too.

        Readers look for the end of a file first, and then read record by record until there. So the new end is written
        first, then the head of a record that readers skip and that leads there, then all behind that head, and the true
        head last. A process that is killed meanwhile leaves the file with this chunk or without it; but for the moment
        between the first two writes, in which ``rosbags`` goes on behind the last end and fails.
        """
        whole = data + end
        tail = len(whole) - len(_END)
        try:
            if self._end and tail >= len(_END):
                self._write(_END, self._end + tail)
                self._write(struct.pack("<BQ", _SKIPPED, tail - _RECORD_HEAD), self._end)
                self._write(whole[_RECORD_HEAD:tail], self._end + _RECORD_HEAD)
                self._write(whole[:_RECORD_HEAD], self._end)
                if not end:  # which is in the data, and tells where the index is, that is there now
                    self._write(whole[tail:], self._end + tail)
            else:
                self._write(whole, self._end)
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._fd, self._end)
                if self._end:
                    self._write(_END, self._end)
            raise
        self._end += len(data)

    def _write(self, data: bytes, at: int) -> None:
        rest = memoryview(data)
        while rest:
            written = os.pwrite(self._fd, rest, at)
            rest, at = rest[written:], at + written
