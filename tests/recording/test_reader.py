"""The reader finds recordings by the paths that a user gives, and reads their content, also from cut files."""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from q2r2_control.errors import RecordingError
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.recording import messages
from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.reader import Recording, recordings_in, spans_of
from q2r2_control.recording.tick_rows import numbers_in, tick_labels, tick_type
from q2r2_control.teleop.reasons import TeleopReason
from tests.recording.runs import pipeline

BEGINS, ENDS, DISCARDED = TeleopReason.EPISODE_BEGINS, TeleopReason.EPISODE_ENDS, TeleopReason.EPISODE_DISCARDED
SUCCEEDED, FAILED = TeleopReason.EPISODE_SUCCEEDED, TeleopReason.EPISODE_FAILED

CASES = {
    "none at all: the whole run": ([], [(-math.inf, math.inf, False, None)]),
    "two, one after the other": (
        [(1.0, BEGINS), (2.0, ENDS), (3.0, BEGINS), (4.0, ENDS)],
        [(1.0, 2.0, False, None), (3.0, 4.0, False, None)],
    ),
    "one that the run ends": ([(1.0, BEGINS)], [(1.0, math.inf, False, None)]),
    "one that is discarded while it goes on": ([(1.0, BEGINS), (2.0, DISCARDED)], [(1.0, 2.0, True, None)]),
    "one that is discarded after it has ended": (
        [(1.0, BEGINS), (2.0, ENDS), (2.5, DISCARDED), (3.0, BEGINS), (4.0, ENDS)],
        [(1.0, 2.0, True, None), (3.0, 4.0, False, None)],
    ),
    "other events": (
        [(0.5, TeleopReason.MARK), (1.0, BEGINS), (1.5, TeleopReason.POSE_SILENT)],
        [(1.0, math.inf, False, None)],
    ),
    "success and failure of the one that goes on, which they end": (
        [(1.0, BEGINS), (2.0, SUCCEEDED), (3.0, BEGINS), (4.0, FAILED)],
        [(1.0, 2.0, False, True), (3.0, 4.0, False, False)],
    ),
    "failure of the last one, which has ended": (
        [(1.0, BEGINS), (2.0, ENDS), (2.5, FAILED)],
        [(1.0, 2.0, False, False)],
    ),
    "what was said last": ([(1.0, BEGINS), (2.0, FAILED), (2.5, SUCCEEDED)], [(1.0, 2.0, False, True)]),
    "failure of the run, where no episode is told of": ([(1.0, FAILED)], [(-math.inf, math.inf, False, False)]),
}


def events(*told: tuple[float, ReasonKind]) -> list[Event]:
    return [Event(t, "left", "engaged", "engaged", Reason(kind)) for t, kind in told]


@pytest.mark.parametrize(("told", "expected"), CASES.values(), ids=CASES)
def test_the_events_of_a_recording_give_the_episodes_of_its_operator_and_their_ratings(
    told: list[tuple[float, ReasonKind]], expected: list[tuple[float, float, bool, bool | None]]
) -> None:
    spans = spans_of(events(*told))
    assert [(span.start, span.end, span.discarded, span.success) for span in spans] == expected
    assert [span.number for span in spans] == ([0] if math.isinf(spans[0].start) else [1, 2][: len(expected)])


def test_for_a_whole_run_the_operators_rating_replaces_the_check_of_its_task() -> None:
    for told, success in (([], True), ([(1.0, FAILED)], False), ([(1.0, BEGINS)], None)):
        assert [span.success for span in spans_of(events(*told), run_succeeded=True)] == [success]


def test_recordings_in_folders_are_found_in_the_order_of_their_names_and_no_recording_is_found_twice(
    tmp_path: Path,
) -> None:
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / f"{name}.mcap").touch()
    first, second = tmp_path / "a" / "a.mcap", tmp_path / "b" / "b.mcap"
    assert recordings_in([tmp_path]) == [first, second]
    assert recordings_in([second, tmp_path]) == [second, first]
    (tmp_path / "empty").mkdir()
    for path, what in ((tmp_path / "empty", "no file .mcap in it"), (tmp_path / "missing", "no such file or folder")):
        with pytest.raises(RecordingError, match=f"{path.name}: {what}"):
            recordings_in([path])


def test_reading_a_file_that_is_still_written_ends_with_the_data_that_it_had_at_first(tmp_path: Path) -> None:
    """A verdict is computed from a file that goes on growing. Data that comes later is left for the next reading."""
    about = About.of(pipeline(), realtime=True, notes={}, cameras=())
    topic = messages.Topic(1, messages.STATE, messages.TEXT)
    with BagWriter(tmp_path / "growing.mcap", [topic], about) as bag:

        def write(number: int) -> None:
            bag.write([messages.Message(1, number, about.epoch + number, 0, b"")])
            bag.flush()

        for number in range(3):
            write(number)
        found: list[int] = []
        for several in Recording(tmp_path / "growing.mcap").messages():
            found += [message.number for message in several]
            assert len(found) <= 3
            write(len(found) + 2)
        assert found == [0, 1, 2]


def test_a_file_that_ends_at_any_byte_is_read_up_to_its_end_and_does_not_count_as_damaged(tmp_path: Path) -> None:
    """A killed writer leaves the first part of a file, which may end in the middle of any record."""
    about = About.of(pipeline(), realtime=True, notes={}, cameras=())
    topic = messages.Topic(1, messages.STATE, messages.TEXT)
    whole, cut = tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    ends: list[int] = []
    with BagWriter(whole, [topic], about) as bag:
        for number in range(3):
            bag.write([messages.Message(1, number, about.epoch + number, 0, messages.text("state"))])
            bag.flush()
            ends.append(whole.stat().st_size)
        bag.close(Conclusion())
    data = whole.read_bytes()
    begin = data.index(b"\x28\xb5\x2f\xfd")  # These bytes begin the content of the first chunk.
    for size in (*range(0, begin, 97), *range(1, 40)):
        cut.write_bytes(data[:size])
        assert messages_or_fault(cut) in (
            [],
            "the file is empty",
            "no metadata q2r2_control",
            "killed before it had written",
        )
    # The file ends at every byte of the second chunk, and at every fourth byte of the other records.
    for size in sorted({*range(*ends[:2]), *range(begin, len(data), 4), len(data) - 1}):
        cut.write_bytes(data[:size])
        recording = Recording(cut)
        found = [message.number for several in recording.messages() for message in several]
        assert not recording.closed
        # After each chunk comes an index of the chunk's messages, which a reader does not need.
        assert found == [0, 1, 2][: len(found)]
        assert len(found) >= sum(end <= size for end in ends)


def messages_or_fault(file: Path) -> list[messages.Message] | str | None:
    try:
        return [message for several in Recording(file).messages() for message in several]
    except RecordingError as error:
        found = re.search("the file is empty|no metadata q2r2_control|killed before it had written", str(error))
        return None if found is None else found.group(0)


def test_a_completed_file_counts_as_damaged_if_one_of_its_records_would_end_beyond_the_file(tmp_path: Path) -> None:
    about = About.of(pipeline(), realtime=True, notes={}, cameras=())
    file = tmp_path / "file.mcap"
    with BagWriter(file, [messages.Topic(1, messages.STATE, messages.TEXT)], about) as bag:
        bag.write([messages.Message(1, 0, about.epoch, 0, messages.text("state"))])
        bag.close(Conclusion())
    data, place = bytearray(file.read_bytes()), len(MCAP0_MAGIC)
    while data[place] != Opcode.CHUNK:
        place += 9 + int.from_bytes(data[place + 1 : place + 9], "little")
    data[place + 4] = 0x7F  # The byte is a part of the chunk's length.
    file.write_bytes(data)
    with pytest.raises(RecordingError, match="damaged"):
        list(Recording(file).messages())


ARMS, NAMES = ("left", "right"), ("left_A1", "left_A2", "right_A1_with_a_longer_name")
STAMPS = np.array([1_500_000_000, (2**31 - 1) * 10**9])
POSITIONS, VELOCITIES, EFFORTS = (np.arange(first, first + 3, dtype=np.float64) for first in (1, 4, 7))


@pytest.mark.parametrize(
    ("kind", "example"),
    [
        (messages.JOINTS, messages.joint_state(list(NAMES), POSITIONS, VELOCITIES, EFFORTS)),
        (messages.TRAJECTORY, messages.joint_trajectory(list(NAMES), POSITIONS, VELOCITIES, EFFORTS)),
    ],
    ids=["joint state", "trajectory"],
)
def test_a_filled_template_of_a_message_equals_the_message_that_rosbags_writes(kind: str, example: Any) -> None:
    numbers = np.random.default_rng(0).normal(size=(2, 9))
    for row, stamp, payload in zip(
        numbers, STAMPS.tolist(), messages.MessageTemplate(kind, example, 9).filled(numbers, STAMPS), strict=True
    ):
        message: Any = messages.STORE.deserialize_cdr(payload, kind)
        assert bytes(messages.STORE.serialize_cdr(message, kind)) == payload
        if kind == messages.JOINTS:
            found = [message.position, message.velocity, message.effort]
        else:
            found = [message.points[0].positions, message.points[0].velocities, message.points[0].accelerations]
        np.testing.assert_array_equal(np.concatenate(found), row)
        assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp


def test_every_number_of_a_tick_has_its_own_label_and_its_own_index() -> None:
    labels, kind = tick_labels(ARMS, NAMES), tick_type(len(ARMS), len(NAMES))
    assert len(set(labels)) == len(labels) == kind.itemsize // 8
    rows = np.arange(2 * len(labels), dtype=np.float64).view(kind)
    np.testing.assert_array_equal(numbers_in(rows).ravel(), np.arange(2 * len(labels)))
    row = rows[0]
    for label, number in (
        ("index", row["index"]),
        ("tau_external.left_A2", row["tau_external"][1]),
        ("right.holding", row["arms"]["holding"][1]),
        ("left.target.qw", row["arms"]["target"][0, 6]),
        ("slack", row["slack"]),
        ("command_tau.left_A1", row["command_tau"][0]),
        ("solve_time", row["solve_time"]),
    ):
        assert number == labels.index(label)


def test_arrays_and_texts_are_read_as_written_and_an_array_of_a_wrong_length_is_refused() -> None:
    numbers = np.array([[0.5, np.nan, -0.0], [1.0, np.inf, 2.0]])
    payloads = [messages.array(row) for row in numbers]
    assert messages.numbers_of(payloads, 3).tobytes() == numbers.tobytes()
    with pytest.raises(ValueError, match="has not 4 numbers"):
        messages.numbers_of(payloads, 4)
    assert messages.data_of(messages.text("grüezi"), messages.TEXT) == "grüezi"


def test_if_the_last_bytes_of_a_file_point_to_an_index_beyond_its_end_the_file_counts_as_unfinished(
    tmp_path: Path,
) -> None:
    about, file = About.of(pipeline(), realtime=True, notes={}, cameras=()), tmp_path / "cut.mcap"
    with BagWriter(file, [messages.Topic(1, messages.STATE, messages.TEXT)], about) as bag:
        bag.write([messages.Message(1, 0, about.epoch, 0, messages.text("state"))])
        bag.flush()
        unfinished = file.read_bytes()
        bag.close(Conclusion())
    footer = struct.pack("<BQQQI", 2, 20, 2**62, 0, 0)
    file.write_bytes(unfinished + footer + file.read_bytes()[-8:])
    assert not Recording(file).closed
