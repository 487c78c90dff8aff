"""The process that writes a recording, as the run sees it.

A process and not a thread, which would take Python's interpreter from the loop for milliseconds; started anew and not
forked, since a fork of a process with threads (numba, MuJoCo, BLAS) may hang. Not by ``multiprocessing``, which imports
the caller's main module once more.
"""

from __future__ import annotations

import json
import os
import pickle
import select
import signal
import subprocess
import sys

from q2r2_control.recording.ring import Ring, new_memory
from q2r2_control.recording.writer import LONGEST_REASON, Setup

ROOM = 8 << 20  # for ticks that wait to be written [bytes]; one of two arms with seven joints each takes 1.6 kB
_STARTING = 6.0  # times as long a patience with a writer that has not taken anything yet
# Signals first, since a Ctrl-C may come at once; modules are looked for where this process looks.
_PROGRAM = """\
import signal
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from q2r2_control.recording.writer import main
main(int(sys.argv[2]), int(sys.argv[3]))
"""


class WriterProcess:
    """Begins with its imports at once, so that it is there when a run begins. To be ended by :meth:`finish`."""

    def __init__(self, room: int = ROOM) -> None:
        """``room`` [bytes] for ticks that wait. Raises :class:`OSError` where there can be no such process."""
        memory = new_memory(room)
        try:
            self.ring = Ring(memory)
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-P",
                    "-c",
                    _PROGRAM,
                    json.dumps([*map(str, sys.path)]),
                    str(memory),
                    str(os.getpid()),
                ],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                pass_fds=(memory,),
                bufsize=0,
                process_group=0,  # a terminal's Ctrl-C is for the run
            )
        finally:
            os.close(memory)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        os.set_blocking(self._output.fileno(), False)
        self.pid = self._process.pid
        self._begun = False

    def begin(self, setup: Setup) -> None:
        """Say what to write, before the first tick is put. Raises :class:`ValueError` where the ring is too small."""
        if not self.ring.put(pickle.dumps(setup)):
            raise ValueError("the ring is not empty")
        self.ring.finish()
        self._begun = True

    def fault(self) -> str | None:
        """Why it has ended before it was told to; None while it has not. Does not wait."""
        said = self._output.read(LONGEST_REASON)
        if said is None or (not said and self._process.poll() is None):  # nothing yet, or not quite ended
            return None
        return said.decode(errors="replace") if said else _how(self._process.returncode)

    def finish(self, patience: float) -> str | None:
        """Let it write what there is, and end. Returns why it did not, or None.

        One that gets nowhere for ``patience`` [s] is killed, and one that was told of no run at once.
        """
        fault = None
        if self._begun:
            self.ring.finish()
            self._input.close()
            fault = self._last_words(patience)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._input.close()
        self._output.close()
        return fault

    def _last_words(self, patience: float) -> str | None:
        late = f"the disk took no data for {patience:g} s"
        answer = select.poll()
        answer.register(self._output, select.POLLIN)
        reached = self.ring.progress
        # On a machine that is busy with other work its imports alone may take that long.
        while not answer.poll(1000.0 * (patience if any(reached) else _STARTING * patience)):
            if self.ring.progress == reached:
                return late
            reached = self.ring.progress
        said = self._output.read(LONGEST_REASON)
        try:
            code = self._process.wait(patience)
        except subprocess.TimeoutExpired:
            return late
        if said:
            return said.decode(errors="replace")
        return _how(code) if code else None


def _how(code: int) -> str:
    """How a process ended that said nothing."""
    if code < 0:
        return f"the process that writes it was ended by {signal.Signals(-code).name}"
    return f"the process that writes it ended with exit code {code}"
