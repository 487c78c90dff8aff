"""A file is whole wherever its writer is killed: after each of its writes, and in the middle of one."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from q2r2_control.recording import mcap_file, topics
from q2r2_control.recording.bag import definitions, qos_text
from q2r2_control.recording.mcap_file import McapFile
from q2r2_control.recording.rows import text_record

TOPIC = topics.Topic(1, "/q2r2/state", "std_msgs/msg/String", None)
SMALL = 50  # bytes that the system writes at once, within a page
TEXTS = ("first", "second " * 60, "third " * 30)


class Killed(BaseException):
    """The process is no more."""


def write_texts(path: Path, told: Callable[[int], None] = lambda texts: None) -> None:
    """A text a chunk, then a note and the index; tells how many texts are in the file."""
    file = McapFile(path)
    file.add_topics([TOPIC], definitions([TOPIC]), qos_text())
    file.begin()
    told(0)
    for number, text in enumerate(TEXTS):
        file.add([(TOPIC, text_record(TOPIC.channel, number, number, text))])
        file.flush()
        told(number + 1)
    file.add_metadata("note", {"ended_by": "an operator who had enough of it"})
    file.close()


HEAD = 9  # of a record [bytes]


def kill_after(budget: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the process write this many bytes; what it does not write as a whole it has written in part."""
    left, write = budget, os.pwrite

    def pwrite(fd: int, data: memoryview, at: int) -> int:
        nonlocal left
        # Behind a new end comes the head that leads there: the moment between them is not to be had.
        if len(data) == HEAD:
            return write(fd, data, at)
        if len(data) <= left:
            left -= len(data)
            return write(fd, data, at)
        if len(data) > SMALL:
            write(fd, data[:left], at)
        raise Killed

    monkeypatch.setattr(mcap_file.os, "pwrite", pwrite)


def test_a_file_is_whole_wherever_its_writer_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kills = complete = 0
    for budget in count(0, 7):
        path = tmp_path / f"{budget}.mcap"
        known = -1

        def tell(texts: int) -> None:
            nonlocal known
            known = texts

        with monkeypatch.context() as patched:
            kill_after(budget, patched)
            try:
                write_texts(path, tell)
            except Killed:
                kills += 1
            else:
                complete = budget
        if known < 0:  # not even its head
            continue
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            texts = [bytes(data[8:-1]).decode() for _, _, data in reader.messages()]
        with path.open("rb") as stream:
            bare = [message.data for _, _, message in make_reader(stream).iter_messages()]
        assert texts == list(TEXTS[: len(texts)])
        assert len(bare) == len(texts)
        assert known <= len(texts) <= known + 1
        if complete:
            break
    assert kills > 100
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(TEXTS)
