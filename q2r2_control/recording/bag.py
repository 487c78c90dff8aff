"""Write a bag of rosbag2: an MCAP file, which the package ``mcap`` writes, and a ``metadata.yaml`` of version 9.

ROS is not needed. The YAML follows metadata_io.cpp in https://github.com/ros2/rosbag2. The package ``rosbags``
provides the message types. Its writer (0.11) is not used: it writes neither the sequence numbers of messages nor
attachments, and it may end a chunk between the messages of one tick.
"""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.writer import MCAP0_MAGIC, Writer

from q2r2_control.config.yaml_text import yaml_of
from q2r2_control.recording.about import ABOUT, CELL, CONCLUSION, FIELDS, ROBOT, About, Conclusion
from q2r2_control.recording.messages import STORE, Message, Topic

METADATA_FILE = "metadata.yaml"
_LARGEST_CHUNK = 4 << 20  # A chunk is written as soon as its messages are together larger than this [bytes].
_VERSION = 9
_FOREVER = {"sec": 9223372036, "nsec": 854775807}
_QOS = {
    "history": "keep_last",
    "depth": 10,
    "reliability": "reliable",
    "durability": "volatile",
    "deadline": _FOREVER,
    "lifespan": _FOREVER,
    "liveliness": "automatic",
    "liveliness_lease_duration": _FOREVER,
    "avoid_ros_namespace_conventions": False,
}


class BagWriter(AbstractContextManager["BagWriter"]):
    """Writes a bag, and is a context manager. :meth:`close` completes the file.

    Without :meth:`close`, the file has all messages that were flushed, but no index. If the process is killed, the end
    record is missing too; ``mcap recover`` repairs such a file. After an error, for example because the disk is full,
    the end record is written without an index. rosbags can read such a file, but could not read it without the end
    record. If no message was written before the error, the file is removed.
    """

    def __init__(self, path: Path, topics: Iterable[Topic], about: About) -> None:
        """Create the file ``path``. Raises :class:`OSError`, as all methods do."""
        self._path, self._topics, self._about = path, tuple(topics), about
        self._counts: Counter[int] = Counter()  # The number of messages of each channel.
        self._first = self._last = about.epoch  # Times of the first and the last message [ns].
        self._stream = path.open("xb")
        self._whole = 0  # The size of the file after the last flush [bytes].
        self._empty = True  # True if no message was flushed.
        # With a smaller limit the writer may end a chunk inside a tick, and a run that is killed would lose that tick.
        self._writer, self._unflushed = Writer(self._stream, chunk_size=sys.maxsize), 0
        try:
            self._channels = self._begin()
        except OSError:
            self._remove()
            raise

    def _begin(self) -> dict[int, int]:
        """Write all records that come before the first message.

        Return a mapping from the channel that a topic has in this program to the channel's id in the file.
        """
        about = self._about
        self._writer.start("ros2", "q2r2_control")
        self._writer.add_metadata(ABOUT, about.texts())
        labels = {topic.name: topic.labels for topic in self._topics if topic.labels}
        for name, kind, text in (
            (CELL, "application/yaml", about.cell),
            (ROBOT, "application/xml", about.robot),
            (FIELDS, "application/json", json.dumps(labels)),
        ):
            self._writer.add_attachment(about.epoch, about.epoch, name, kind, text.encode())
        channels = self._register()
        self.flush()
        return channels

    def _remove(self) -> None:
        with suppress(OSError):  # Closing can fail too, for example if the disk is full.
            self._stream.close()
        with suppress(OSError):
            self._path.unlink()
            self._path.parent.rmdir()  # The recorder made this folder only for this file.

    def write(self, messages: Iterable[Message]) -> None:
        """Add the messages of whole ticks, in the order of time.

        They are written to the file by :meth:`flush`, which is called here too when many messages wait.
        """
        for channel, number, time, sent, payload in messages:
            self._writer.add_message(self._channels[channel], time, payload, sent, number)
            self._first = min(self._first, time) if self._counts else time
            self._last = max(self._last, time)
            self._counts[channel] += 1
            self._unflushed += len(payload)
        if self._unflushed > _LARGEST_CHUNK:
            self.flush()

    def flush(self) -> None:
        """Write all added messages to the file, as one chunk."""
        self._writer.flush()
        self._stream.flush()
        self._unflushed = 0
        self._whole, self._empty = self._stream.tell(), not self._counts

    def close(self, conclusion: Conclusion) -> None:
        """Write the remaining messages, the ``conclusion``, the index and ``metadata.yaml``."""
        self.flush()
        texts = conclusion.texts()
        if texts:
            self._writer.add_metadata(CONCLUSION, texts)
        self._writer.finish()
        self._stream.close()
        self._write_metadata({**self._about.notes, **texts})

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with suppress(OSError):  # Closing can fail too, for example if the disk is full.
            self._stream.close()
        if error is None:
            return
        if self._empty:
            self._remove()
            return
        end = RecordBuilder()
        DataEnd(0).write(end)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(end)
        with suppress(OSError):
            os.truncate(self._path, self._whole)  # This removes a chunk of which only a part was written.
            with self._path.open("ab") as stream:
                stream.write(end.end() + MCAP0_MAGIC)

    def _register(self) -> dict[int, int]:
        """Declare the topics. Return a mapping from each channel in this program to the channel's id in the file."""
        qos = {"offered_qos_profiles": yaml_of([_QOS]).strip()}
        schemas: dict[str, int] = {}
        for kind in dict.fromkeys(topic.type for topic in self._topics):
            definition, _ = STORE.generate_msgdef(kind, ros_version=2)
            schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition.encode())
        return {
            topic.channel: self._writer.register_channel(topic.name, "cdr", schemas[topic.type], qos)
            for topic in self._topics
        }

    def _write_metadata(self, custom: Mapping[str, str]) -> None:
        times: dict[str, Any] = {
            "starting_time": {"nanoseconds_since_epoch": self._first},
            "duration": {"nanoseconds": self._last - self._first},
            "message_count": self._counts.total(),
        }
        information = {
            "version": _VERSION,
            "storage_identifier": "mcap",
            "relative_file_paths": [self._path.name],
            **times,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": [_QOS],
                        "type_description_hash": STORE.hash_rihs01(topic.type),
                    },
                    "message_count": self._counts[topic.channel],
                }
                for topic in self._topics
            ],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": self._path.name, **times}],
            "custom_data": dict(custom) or None,
            "ros_distro": "jazzy",
        }
        target = self._path.with_name(METADATA_FILE)
        part = target.with_suffix(".part")
        # The copy through JSON has a separate dict for each use of _QOS. So the YAML has no anchors and no aliases.
        plain = json.loads(json.dumps({"rosbag2_bagfile_information": information}))
        part.write_text(yaml_of(plain), encoding="utf-8")
        os.replace(part, target)
