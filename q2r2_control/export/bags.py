"""Writes each episode of a recording as a bag of its own: its messages as they were recorded, to the byte.

For tools that take an episode for a file. What such a file lacks is what came before, which a replay needs, and which
this package's own commands read in the recording that it was cut out of.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from q2r2_control.errors import RecordingError
from q2r2_control.export.episodes import EpisodePart, parts_to_export
from q2r2_control.recording.about import CUT_OUT_OF, Conclusion
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.messages import Message
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.ros_recording import open_recording
from q2r2_control.recording.ros_topics import is_latched
from q2r2_control.recording.topics import STATE, Topic


def write_bags(file: Path, folder: Path) -> int:
    """Write the episodes of a recording but those that its operator discarded, each into a new folder in ``folder``.

    Returns how many. Raises :class:`RecordingError` for a bad recording, and where two episodes have one name.
    """
    recording = open_recording(file)
    made: list[Path] = []
    try:
        for part in parts_to_export(file):
            bag = folder / part.name_in(recording.file)
            if bag.exists():
                raise RecordingError(f"{file}: two recordings have this name; allowed: each one once")
            bag.mkdir()
            made.append(bag)
            _write(recording, part, bag / f"{bag.name}.mcap")
    except RecordingError:
        for bag in made:
            shutil.rmtree(bag)
        raise
    return len(made)


def _write(recording: Recording, part: EpisodePart, path: Path) -> None:
    about, span = recording.about, part.span
    start = about.epoch + max(round(span.start * 1e9), 0) if not span.whole else 0
    end = about.epoch + round(span.end * 1e9) if span.end < float("inf") else None
    conclusion = Conclusion(span.success, recording.conclusion.ended_by if end is None else None)
    topics = recording.declared_topics
    notes = {**about.notes, CUT_OUT_OF: recording.file.name, "episode": str(part.number)}
    with BagWriter(path, topics.values(), replace(about, notes=notes)) as bag:
        for messages in _within(recording, topics, start, end):
            bag.write(messages)
            bag.flush()
        bag.close(conclusion)


def _within(recording: Recording, topics: dict[int, Topic], start: int, end: int | None) -> Iterator[list[Message]]:
    """The messages from ``start`` to ``end`` [ns] of day, chunk by chunk.

    At the start there is what lasts of what was said before.
    """
    lasting: dict[int, Message] = {}
    begun = False
    for messages in recording.messages():
        inside = [one for one in messages if start <= one.time and (end is None or one.time <= end)]
        for one in messages:
            name = topics[one.channel].name
            if one.time < start and (is_latched(name) or name == STATE):
                lasting[one.channel] = one._replace(time=start, sent=start)
        if inside and not begun:
            begun = True
            inside = [*lasting.values(), *inside]
        if inside:
            yield inside
