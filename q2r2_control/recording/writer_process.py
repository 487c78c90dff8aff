"""The process that writes a recording, as the run sees it."""

from __future__ import annotations

import json
import os
import pickle

from q2r2_control.recording.about import Conclusion
from q2r2_control.recording.helper_process import HelperProcess
from q2r2_control.recording.picture_channel import PictureChannel
from q2r2_control.recording.ring import Ring, new_memory
from q2r2_control.recording.writer import RingSetup

ROOM = 8 << 20  # for ticks that wait to be written [bytes]; one of two arms with seven joints each takes 1.6 kB


class WriterProcess:
    """Begins with its imports at once, so that it is there when a run begins. To be ended by :meth:`finish`."""

    def __init__(self, room: int = ROOM, pictures: PictureChannel | None = None) -> None:
        """``room`` [bytes] for ticks that wait; ``pictures`` come from elsewhere.

        Raises :class:`OSError` where there can be no such process.
        """
        memory = new_memory(room)
        fds = (memory,) if pictures is None else (memory, pictures.memory, pictures.listening)
        rings = [Ring(memory)] if pictures is None else [Ring(memory), pictures.ring]
        self.ring = rings[0]
        try:
            self._process = HelperProcess(
                "writes it",
                "q2r2_control.recording.writer",
                fds,
                lambda: [number for ring in rings for number in ring.progress],
            )
        finally:
            os.close(memory)
        self.pid = self._process.pid
        self._begun = False

    def begin(self, setup: RingSetup) -> None:
        """Say what to write, before the first tick is put. Raises :class:`ValueError` where the ring is too small."""
        if not self.ring.put(pickle.dumps(setup)):
            raise ValueError("the ring is not empty")
        self.ring.finish()
        self._begun = True

    def fault(self) -> str | None:
        """Why it has ended before it was told to; None while it has not. Does not wait."""
        return self._process.fault()

    def finish(self, patience: float, conclusion: Conclusion) -> str | None:
        """Let it write what there is and the ``conclusion``, and end. Returns why it did not, or None.

        One that gets nowhere for ``patience`` [s] is killed, and one that was told of no run at once.
        """
        fault = None
        if self._begun:
            self.ring.finish()
            told = json.dumps(conclusion.texts()).encode()
            fault = self._process.last_words(patience, f"the disk took no data for {patience:g} s", told)
        self._process.end()
        return fault
