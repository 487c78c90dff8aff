"""A process beside the loop, as the run sees it: started anew, told to end by its standard input, heard on its output.

A process and not a thread, which would take Python's interpreter from the loop for milliseconds; started anew and not
forked, since a fork of a process with threads (numba, MuJoCo, BLAS) may hang. Not by ``multiprocessing``, which imports
the caller's main module once more.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence

from q2r2_control.recording.helper import LONGEST_REASON

_STARTING = 6.0  # times as long a patience with a process that has not taken anything yet
# Signals first, since a Ctrl-C may come at once; modules are looked for where this process looks.
_PROGRAM = """\
import signal
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    signal.signal(number, signal.SIG_IGN)
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from q2r2_control.recording.helper import run
run(sys.argv[2], *map(int, sys.argv[3:]))
"""


class HelperProcess:
    """Begins with its imports at once. To be ended by :meth:`last_words` and :meth:`end`."""

    def __init__(
        self, what: str, module: str, fds: Sequence[int], progress: Callable[[], Sequence[int]], **environment: str
    ) -> None:
        """Call ``module.main`` in a process with the open ``fds`` and the number of this process as its arguments.

        ``what`` it does, for faults. ``progress`` are numbers that change while it gets on, zeros before it begins.
        ``environment``: variables that it has where this process has not. Raises :class:`OSError`.
        """
        self._what, self._progress = what, progress
        arguments = [json.dumps([*map(str, sys.path)]), module, *map(str, (*fds, os.getpid()))]
        variables: Mapping[str, str] = {**environment, **os.environ}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _PROGRAM, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            pass_fds=fds,
            bufsize=0,
            env=variables,
            process_group=0,  # a terminal's Ctrl-C is for the run
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._input, self._output = self._process.stdin, self._process.stdout
        os.set_blocking(self._output.fileno(), False)
        self.pid = self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it has not ended yet."""
        return self._process.poll() is None

    def fault(self) -> str | None:
        """Why it has ended before it was told to; None while it has not. Does not wait."""
        said = self._output.read(LONGEST_REASON)
        if said is None or (not said and self._process.poll() is None):  # nothing yet, or not quite ended
            return None
        return said.decode(errors="replace") if said else self._how(self._process.returncode)

    def last_words(self, patience: float, late: str) -> str | None:
        """Let it do what there is, and end. Returns why it did not, or None; ``late`` if it stops getting on.

        That is for ``patience`` [s].
        """
        self._input.close()
        answer = select.poll()
        answer.register(self._output, select.POLLIN)
        reached = self._progress()
        # On a machine that is busy with other work its imports alone may take that long.
        while not answer.poll(1000.0 * (patience if any(reached) else _STARTING * patience)):
            if self._progress() == reached:
                return late
            reached = self._progress()
        said = self._output.read(LONGEST_REASON)
        try:
            code = self._process.wait(patience)
        except subprocess.TimeoutExpired:
            return late
        if said:
            return said.decode(errors="replace")
        return self._how(code) if code else None

    def end(self) -> None:
        """Kill it if it is there yet."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        self._input.close()
        self._output.close()

    def _how(self, code: int) -> str:
        """How it ended where it said nothing."""
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        return f"the process that {self._what} {'was ended' if code < 0 else 'ended'} {how}"
