"""What makes a folder with an MCAP file a bag of rosbag2: definitions of types, and metadata.yaml, version 9.

Written by hand, since the package is to run without ROS; the rules are those of rosbag2_storage in ROS 2 Jazzy
(https://github.com/ros2/rosbag2, metadata_io.cpp). Types and their hashes are from rosbags.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from q2r2_control.inputs.messages import Dialect, message_types
from q2r2_control.recording.topics import Topic

METADATA_FILE = "metadata.yaml"
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


def qos_text() -> str:
    """How the topics would be offered, as rosbag2 notes it at each topic."""
    return str(yaml.safe_dump([_QOS], sort_keys=False)).strip()


def definitions(topics: Iterable[Topic]) -> dict[str, str]:
    """The definition of each type, with those of the types in it, in the format ros2msg."""
    store = message_types(Dialect.ROS2)
    return {topic.type: store.generate_msgdef(topic.type, ros_version=2)[0] for topic in topics}


def write_metadata(
    file: Path, topics: Iterable[Topic], counts: Mapping[int, int], first: int, last: int, custom: Mapping[str, str]
) -> None:
    """Write metadata.yaml beside ``file``, whose messages are from ``first`` to ``last`` [ns]. Raises OSError."""
    store = message_types(Dialect.ROS2)
    times: dict[str, Any] = {
        "starting_time": {"nanoseconds_since_epoch": first},
        "duration": {"nanoseconds": last - first},
        "message_count": sum(counts.values()),
    }
    information = {
        "version": _VERSION,
        "storage_identifier": "mcap",
        "relative_file_paths": [file.name],
        **times,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [_QOS],
                    "type_description_hash": store.hash_rihs01(topic.type),
                },
                "message_count": counts.get(topic.channel, 0),
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "files": [{"path": file.name, **times}],
        "custom_data": dict(custom) or None,
        "ros_distro": "jazzy",
    }
    target = file.with_name(METADATA_FILE)
    part = target.with_suffix(".part")
    text = _Dumper.text({"rosbag2_bagfile_information": information})
    part.write_text(text, encoding="utf-8")
    os.replace(part, target)


class _Dumper(yaml.SafeDumper):
    """Without references, which yaml-cpp follows but people do not like to read."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    @classmethod
    def text(cls, data: Any) -> str:
        return str(yaml.dump(data, Dumper=cls, sort_keys=False))
