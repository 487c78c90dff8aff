"""Recordings can be read after another program has rewritten them with its own chunks and order."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Schema
from mcap.records import Message as McapMessage
from mcap.summary import Summary
from mcap.writer import CompressionType, IndexType, Writer

from q2r2_control.errors import RecordingError
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.tick_rows import SAMPLE_FIELDS, tick_type
from tests.recording.runs import ARMS, JOINTS, file_of, pipeline, record

_One = tuple[Schema | None, Channel, McapMessage]
DURATION = 0.7  # Duration of a run [s]. The run has more ticks than a TickAssembly keeps back.


class Read(NamedTuple):
    rows: bytes
    samples: bytes
    states: dict[int, str]


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return file_of(record(tmp_path_factory.mktemp("recorded"), pipeline(), DURATION))


@pytest.fixture(scope="module")
def ours(file: Path) -> Read:
    read = read_of(file)
    assert len(read.samples) > 0
    assert read.states
    return read


def read_of(path: Path) -> Read:
    chunks = list(Recording(path).chunks())
    for chunk in chunks:  # Each chunk has all samples and states of its ticks, and no others.
        numbers = chunk.numbers.tolist()
        assert chunk.samples[:, 0].tolist() == np.repeat(numbers, chunk.rows["samples"].astype(int)).tolist()
        assert chunk.states.keys() <= set(numbers)
    states = {number: text for chunk in chunks for number, text in chunk.states.items()}
    rows, samples = (b"".join(getattr(one, name).tobytes() for one in chunks) for name in ("rows", "samples"))
    return Read(rows, samples, states)


def written_again(
    file: Path, target: Path, messages: Iterable[_One], *, extras_first: bool = True, **settings: Any
) -> Path:
    """Write ``messages`` with the writer of ``mcap``, which declares each channel before its first message."""
    channels: dict[int, int] = {}
    with file.open("rb") as stream, target.open("wb") as out:
        reader, writer = make_reader(stream), Writer(out, **settings)
        writer.start("ros2", "another program")

        def add_extras() -> None:
            for metadata in reader.iter_metadata():
                writer.add_metadata(metadata.name, metadata.metadata)
            for one in reader.iter_attachments():
                writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)

        if extras_first:
            add_extras()
        for schema, channel, message in messages:
            assert schema is not None
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            times = message.log_time, message.data, message.publish_time, message.sequence
            writer.add_message(channels[channel.id], *times)
        if not extras_first:
            add_extras()
        writer.finish()
    return target


def summary_of(file: Path) -> Summary:
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary


def in_order(file: Path) -> Iterator[_One]:
    with file.open("rb") as stream:
        yield from make_reader(stream).iter_messages()


def by_topic(file: Path) -> list[_One]:
    found: defaultdict[int, list[_One]] = defaultdict(list)
    for one in in_order(file):
        found[one[1].id].append(one)
    return [one for of_topic in found.values() for one in of_topic]


WRITERS: dict[str, dict[str, Any]] = {
    "whose chunks end in the middle of ticks": {"chunk_size": 300_000},
    "whose chunks have a part of a tick": {"chunk_size": 3_000, "compression": CompressionType.LZ4},
    "who writes no chunks": {"use_chunking": False},
    "who writes metadata and attachments last": {"chunk_size": 30_000, "extras_first": False},
    "who writes no indexes and no checksums": {
        "chunk_size": 30_000,
        **{"index_types": IndexType.NONE, "repeat_channels": False, "use_statistics": False, "enable_crcs": False},
    },
}


@pytest.mark.parametrize("settings", WRITERS.values(), ids=WRITERS)
def test_a_recording_has_the_same_content_after_it_was_rewritten_by_a_writer(
    file: Path, ours: Read, tmp_path: Path, settings: dict[str, Any]
) -> None:
    again = written_again(file, tmp_path / "again.mcap", in_order(file), **settings)
    assert read_of(again) == ours
    names = {topic.name for topic in Recording(again).declared_topics.values()}
    assert names == {topic.name for topic in Recording(file).declared_topics.values() if topic.name in names}
    assert len(names) > 8


def test_a_file_is_refused_if_it_is_sorted_by_topic_because_its_ticks_come_without_hand_samples(
    file: Path, tmp_path: Path
) -> None:
    """Each chunk of the file has messages of one topic only. A replay of a tick without its samples would differ."""
    again = written_again(file, tmp_path / "again.mcap", by_topic(file), chunk_size=10_000)
    with pytest.raises(RecordingError, match="mcap sort puts them in order"):
        read_of(again)


def test_a_cut_file_of_another_writer_is_read_up_to_the_cut(file: Path, ours: Read, tmp_path: Path) -> None:
    """The last whole chunk before the cut may end within a tick. Only this tick is left out of what is read."""
    again = written_again(file, tmp_path / "again.mcap", in_order(file), chunk_size=3_000)
    data, cut, lengths = again.read_bytes(), tmp_path / "cut.mcap", []
    for size in np.linspace(0.3, 0.95, 25) * len(data):
        cut.write_bytes(data[: int(size)])
        read = read_of(cut)
        assert ours.rows.startswith(read.rows)
        assert ours.samples.startswith(read.samples)
        rows = np.frombuffer(read.rows, tick_type(len(ARMS), len(JOINTS)))
        assert rows["samples"].sum() == len(read.samples) // (8 * len(SAMPLE_FIELDS))
        lengths.append(len(read.rows))
    assert lengths == sorted(lengths)
    assert lengths[-1] > 0.8 * len(ours.rows)


def test_a_cut_file_that_ends_with_zeros_is_read_up_to_the_zeros(file: Path, ours: Read, tmp_path: Path) -> None:
    """If the computer loses power, the file system may keep the length of a file, but not its last data."""
    cut, data = tmp_path / "cut.mcap", file.read_bytes()
    first = min(summary_of(file).chunk_indexes, key=lambda index: index.chunk_start_offset)
    cut.write_bytes(data[: first.chunk_start_offset + first.chunk_length] + bytes(50_000))
    read = read_of(cut)
    assert read.rows
    assert ours.rows.startswith(read.rows)


def test_a_file_with_a_wrong_byte_is_read_up_to_the_damaged_chunk_and_an_error_reports_the_damage(
    file: Path, ours: Read, tmp_path: Path
) -> None:
    again = written_again(file, tmp_path / "again.mcap", in_order(file), chunk_size=30_000)
    chunks = sorted(index.chunk_start_offset + index.chunk_length for index in summary_of(again).chunk_indexes)
    data = bytearray(again.read_bytes())
    data[chunks[len(chunks) // 2] - 100] ^= 0x55
    again.write_bytes(data)
    rows, error = b"", None
    try:
        for chunk in Recording(again).chunks():
            rows += chunk.rows.tobytes()
    except RecordingError as found:
        error = str(found)
    assert error is not None
    assert "damaged" in error
    assert ours.rows.startswith(rows)
    assert len(rows) > 0.4 * len(ours.rows)
