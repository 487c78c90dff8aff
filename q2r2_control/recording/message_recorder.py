"""Records messages as they come, serialized already: it puts a head before each, and another process writes them."""

from __future__ import annotations

from pathlib import Path

from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.base_recorder import BaseRecorder
from q2r2_control.recording.rows import message_record
from q2r2_control.recording.topics import Topic

ROOM = 8 << 20  # for messages that wait to be written [bytes]; both arms' nodes send some 0.6 MB a second
ROOM_WITH_PICTURES = 64 << 20  # of cameras, which have a megabyte each where they are not compressed
_LOOKS = 64  # messages between two looks at whether the writer lives
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

    def put(self, topic: Topic, number: int, received: int, sent: int, payload: bytes) -> None:
        """Take a message: its ``number`` at its sender, when it was received and sent [ns of day], and its CDR.

        One that was received before the last one counts as received with it, since a file is in the order of time.
        """
        self.count += 1
        if self._fault is not None or self.writer is None or not self._begun:
            return
        self._last = max(received, self._last)
        record = message_record(topic.channel, number & _LAST_NUMBER, self._last, max(sent, 0), payload)
        try:
            if not self.writer.ring.put(record):
                self.overflows += 1
        except ValueError:  # larger than all of the room
            self.overflows += 1
        if self.count % _LOOKS == 0:
            self.look()

    def look(self) -> None:
        """Find out whether the writer has failed."""
        if self.writer is not None and self._fault is None:
            self._look()

    @property
    def written(self) -> int:
        """How many messages are in the file."""
        return 0 if self.writer is None else self.writer.ring.written

    def finish(self) -> None:
        """Write what there is, and close the file."""
        self._end(Conclusion())
