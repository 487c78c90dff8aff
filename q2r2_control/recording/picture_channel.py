"""From the process that takes pictures to the one that writes them: memory for messages, and a pipe that tells the end.

Nothing goes through the pipe: its one end is held by the process that takes pictures only, so that the other end is
closed when that process has ended, however it did.
"""

from __future__ import annotations

import os
import select
import time

from q2r2_control.recording.ring import Ring, new_memory

_ROOM = 32 << 20  # [bytes]
_MOST = 64  # pictures at once
_PATIENCE = 30.0  # with pictures that do not come, of a run that has ended [s]


class PictureChannel:
    """As the run has it, which passes the ends on."""

    def __init__(self) -> None:
        """Raises :class:`OSError`."""
        self.memory = new_memory(_ROOM)
        self.ring = Ring(self.memory)  # for its count of what was written only
        self.listening, self.open = os.pipe()

    def close_listening(self) -> None:
        """When the writer has it."""
        os.close(self.listening)

    def close(self) -> None:
        """When the process that takes pictures has it, or there is none; once more does nothing."""
        if self.memory >= 0:
            os.close(self.memory)
            os.close(self.open)
            self.memory = self.open = -1


class PictureSource:
    """The writer's side of it."""

    def __init__(self, memory: int, listening: int) -> None:
        self._ring, self._listening = Ring(memory), listening
        self._ended = False
        self._count = 0
        self._last = time.monotonic()

    def take(self) -> list[bytes]:
        """Some of the next messages."""
        if records := self._ring.take(_MOST):
            self._last = time.monotonic()
        return records

    def written(self, count: int) -> None:
        """So many more are in the file."""
        self._ring.release()
        self._count += count
        self._ring.written = self._count

    def has_ended(self, within: float) -> bool:
        """Whether no more come but what can be taken now; waits for it ``within`` this time [s].

        Of a run that has ended, which would have ended a process that hangs.
        """
        self._ended = self._ended or bool(select.select([self._listening], [], [], within)[0])
        return self._ended or time.monotonic() > self._last + _PATIENCE
