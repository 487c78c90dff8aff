"""Records messages as they come, serialized already: another process writes them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.base_recorder import BaseRecorder
from q2r2_control.recording.messages import Message
from q2r2_control.recording.topics import Topic
from q2r2_control.recording.writer import MessageBatch

ROOM = 8 << 20  # for messages that wait to be written [bytes]; both arms' nodes send some 0.6 MB a second
ROOM_WITH_PICTURES = 64 << 20  # of cameras, which have a megabyte each where they are not compressed
_LAST_NUMBER = 2**32 - 1


class MessageRecorder(BaseRecorder):
    """Writes one file. It never waits: messages for which there is no room are lost, and counted."""

    def __init__(self, parent: Path, name: str, room: int = ROOM) -> None:
        super().__init__(parent, name, room)
        self.count = self.overflows = 0  # messages that came; those of them for which there was no room
        self._last = 0
        self._begun = False

    def begin(self, about: About, topics: tuple[Topic, ...]) -> None:
        """Take messages of these topics from now on."""
        self._begun = self._open(about, None, topics)
        self._last = about.epoch

    def record(self, messages: Iterable[Message]) -> None:
        """Have messages written, in the order of their receipt.

        One that was received before the last one counts as received with it, since a file is in the order of time.
        """
        batch = []
        for message in sorted(messages, key=lambda one: one.time):
            self.count += 1
            self._last = max(message.time, self._last)
            batch.append(message._replace(number=message.number & _LAST_NUMBER, time=self._last))
        self._check_writer()
        if batch and self._begun and self.fault is None and not self._send(MessageBatch(batch)):
            self.overflows += len(batch)

    def finish(self) -> None:
        """Write what there is, and close the file."""
        self._end(Conclusion())
