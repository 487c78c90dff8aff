"""A process beside the loop, as the run sees it: started anew, told to end by its standard input, heard on its output.

A process and not a thread, which would take Python's interpreter from the loop for milliseconds; started anew and not
forked, since a fork of a process with threads (numba, MuJoCo, BLAS) may hang. Not by ``multiprocessing``, which imports
the caller's main module once more.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from q2r2_control.process.signals import how_it_ended
from q2r2_control.recording.helper import LONGEST_REASON, LONGEST_TOLD

_STARTING = 6.0  # times as long a patience with a process that has not taken anything yet: imports take their time
_LOOKS = 0.1  # between two looks at whether it gets on [s]
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

    def last_words(self, patience: float, late: str, told: bytes = b"") -> str | None:
        """Let it do what there is, and end. Returns why it did not, or None; ``late`` if it stops getting on.

        That is for ``patience`` [s] in which no other work kept it off the processors. It is ``told`` some bytes,
        which :func:`helper.told` gives it.
        """
        with suppress(OSError):  # one that has ended already says so below
            os.write(self._input.fileno(), told[:LONGEST_TOLD])
        self._input.close()
        reached, waited = self._progress(), 0.0
        looked, worked = time.monotonic(), self._processor_time()
        while (code := self._code_within(_LOOKS)) is None:  # its exit takes its time too, after its last words
            before, looked = (looked, worked), time.monotonic()
            worked = self._processor_time()
            # One that is ready to run has to wait for a processor, but for the time that it has had of one. Nor does it
            # count that this process had none between two looks.
            idle = min(looked - before[0], 2.0 * _LOOKS)
            waited += max(worked - before[1], 0.0) if self._is_ready_to_run() else idle
            if (now_reached := self._progress()) != reached:
                reached, waited = now_reached, 0.0
            elif waited >= (patience if any(reached) else _STARTING * patience):
                return late
        said = self._output.read(LONGEST_REASON)
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

    def _code_within(self, timeout: float) -> int | None:
        """Its exit code; None where it has not ended within that [s]."""
        try:
            return self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return None

    def _is_ready_to_run(self) -> bool:
        """Whether one of its threads runs or could; only Linux tells that."""
        return any(stat.rpartition(")")[2].split()[0] == "R" for stat in self._of_threads("stat"))

    def _processor_time(self) -> float:
        """Of all its threads that there are [s]; only Linux tells that."""
        return 1e-9 * sum(int(text.split()[0]) for text in self._of_threads("schedstat"))

    def _of_threads(self, name: str) -> Iterator[str]:
        """What the system says of each thread in the file ``name``."""
        for file in Path(f"/proc/{self.pid}/task").glob(f"*/{name}"):
            with suppress(OSError):  # a thread that has ended
                yield file.read_text()

    def _how(self, code: int) -> str:
        """How it ended where it said nothing."""
        return how_it_ended(f"the process that {self._what}", code)
