"""Run a process beside the loop. It gets requests on its standard input, and answers on its standard output.

A thread instead of a process would stop the loop for milliseconds, because only one thread at a time runs Python code.
``multiprocessing`` was tried as well, and has three problems. If the run was killed while it sent 1 MB, 8 of 8
processes with a ``Queue`` waited for the remaining bytes for ever, and closed no file. While a ``Pipe`` is full, its
sender waits, so a ``Pipe`` would need the same threads as this module. And ``multiprocessing`` runs a user's script
again if the script has no main guard.
"""

from __future__ import annotations

import math
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import Any

from q2r2_control.process.scheduling import how_it_ended

_LOOKS = 0.1  # While a process is ending, time between two checks of its progress [s].
_AFTER_KILL = 1.0  # After a kill, longest time to wait until the last answer has been handled [s].
_NO_ROOM = 1e-3  # While there is no room for a request, time between two attempts to queue it [s].


class HelperProcess:
    """A process that starts at once. It ends by :meth:`finish`, by :meth:`kill`, or when this process ends.

    Two threads pass requests and answers on, so that neither :meth:`send` nor the process waits for the other.
    """

    def __init__(
        self,
        what: str,
        module: str,
        on_answer: Callable[[Any], None],
        room: int = 1 << 20,
        idle: float | None = None,
        **environment: str,
    ) -> None:
        """Call ``module.main(requests, answer)`` in a new process.

        Args:
            module: Name of the module.
            what: What the process does, for messages about faults.
            on_answer: A function that gets each answer. It is called in a separate thread. If it raises an exception,
                the process is ended, and :attr:`fault` says why.
            room: Largest size of all requests that wait [bytes].
            idle: If no request comes for this time, the process gets None as a request [s].
            environment: Environment variables of the process. Variables of this process override them.

        Raises:
            OSError: If the process cannot be started.
        """
        self._what, self._on_answer, self._room, self._idle = what, on_answer, room, idle
        code = f"from {__name__} import run_helper; run_helper({module!r})"
        self._process = start_python(code, environment, stdout=subprocess.PIPE)
        self.pid = self._process.pid
        self.fault: str | None = None  # Why the process has ended too early, or without doing everything.
        self._ending = self._killed = False
        self._queue: SimpleQueue[tuple[Any, int] | None] = SimpleQueue()
        self._lock = Lock()
        self._put = self._sent = 0  # Bytes of all requests that were queued, and of all that were sent, so far.
        self._moved = time.monotonic()  # Time at which the process last took or answered something.
        self._listener = Thread(target=self._listen, daemon=True)
        Thread(target=self._feed, daemon=True).start()
        self._listener.start()

    @property
    def alive(self) -> bool:
        return self._listener.is_alive()

    def send(self, request: Any, size: int = 0, *, wait: bool = False) -> bool:
        """Queue a request of ``size`` [bytes], and return whether it was queued.

        If there is no room for the request, it is not queued; with ``wait``, this method waits for room.
        """
        while self.alive:
            with self._lock:
                if self._put + size - self._sent <= self._room:
                    self._put += size
                    self._queue.put((request, size))
                    return True
            if not wait or size > self._room:
                return False
            time.sleep(_NO_ROOM)
        return False

    def finish(self, patience: float, longest: float = math.inf) -> None:
        """Wait until the process has done all requests and has ended.

        If the process neither takes nor answers anything for ``patience`` [s] although processors are free, it is
        killed. It is also killed if it has not ended after ``longest`` [s]. This method does not wait until a killed
        process has ended.
        """
        self._ending = True
        self._queue.put(None)
        self._moved = began = time.monotonic()
        while self._listener.is_alive():
            self._listener.join(_LOOKS)
            now = time.monotonic()
            if self._is_ready_to_run():
                self._moved = now
            if self._listener.is_alive() and (now - self._moved > patience or now - began > longest):
                idle = now - self._moved > patience
                did = f"did nothing for {patience:g} s" if idle else f"did not end within {longest:g} s"
                self.fault = f"the process that {self._what} {did}"
                self.kill()
                return

    def kill(self) -> None:
        """End the process and all processes that it has started, at once. This is not a fault.

        If only the process itself were ended, the processes that it has started would keep files and ports open. They
        would also keep its output pipe open. The end of this pipe shows that the process has ended.
        """
        self._killed = True
        self._end_group()
        self._queue.put(None)
        self._listener.join(_AFTER_KILL)

    def _end_group(self) -> None:
        # If the return code is set, the process has ended. The system may have given its ID to another process.
        if self._process.returncode is None:
            with suppress(OSError):  # The call fails if the process group has already ended.
                os.killpg(self.pid, signal.SIGKILL)

    def _is_ready_to_run(self) -> bool:
        """Return whether at least one thread of the process runs or is ready to run. Only Linux tells this."""
        with suppress(OSError):  # Reading fails if a thread has ended meanwhile.
            states = [file.read_text() for file in Path(f"/proc/{self.pid}/task").glob("*/stat")]
            return any(state.rpartition(")")[2].split()[0] == "R" for state in states)
        return False

    def _feed(self) -> None:
        stream = self._process.stdin
        assert stream is not None
        with suppress(OSError):  # Writing fails if the process has ended.
            while True:
                try:
                    entry = self._queue.get(timeout=self._idle)
                except Empty:
                    entry = None, 0
                if entry is None:
                    break
                request, size = entry
                pickle.dump(request, stream)
                stream.flush()
                self._sent += size
                self._moved = time.monotonic()
        with suppress(OSError):
            stream.close()

    def _listen(self) -> None:
        stream, fault = self._process.stdout, None
        assert stream is not None
        with suppress(EOFError, pickle.UnpicklingError):
            while fault is None:
                answer = pickle.load(stream)
                self._moved = time.monotonic()
                fault = str(answer) if isinstance(answer, RuntimeError) else self._pass_on(answer)
        code = self._process.wait()
        stream.close()
        if fault is None and not self._killed and (code or not self._ending):
            fault = how_it_ended(f"the process that {self._what}", code)
        self.fault = self.fault or fault

    def _pass_on(self, answer: Any) -> str | None:
        """Pass an answer on. If this fails, end the process, and return the reason; otherwise return None."""
        try:
            self._on_answer(answer)
        except Exception as error:
            self._end_group()
            return f"an answer of the process that {self._what} was refused: {reason_of(error)}"
        return None


def start_python(
    code: str, environment: dict[str, str], stdout: int = subprocess.DEVNULL, files: Sequence[int] = ()
) -> subprocess.Popen[bytes]:
    """Start a process that runs the Python ``code`` and reads its input from a pipe.

    The process finds the same modules as this process, and inherits the open ``files``. ``environment`` has additional
    environment variables for the process. Variables of this process override them.
    """
    paths = {"PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}
    return subprocess.Popen(
        [sys.executable, "-P", "-c", code],
        stdin=subprocess.PIPE,
        stdout=stdout,
        stderr=subprocess.DEVNULL,
        env=environment | os.environ | paths,
        pass_fds=files,
        process_group=0,  # In its own group, the process does not get Ctrl-C of a terminal, which is only for the run.
    )


def leave_signals_to_the_run() -> None:
    """Ignore signals in a helper process, because the run ends it."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


def run_helper(module: str) -> None:
    """Call ``module.main`` in the helper process.

    After a failure, the last answer is a RuntimeError with the reason.
    """
    leave_signals_to_the_run()
    stream, sys.stdout = sys.stdout.buffer, sys.stderr  # The run must not read a library's output as an answer.
    lock = Lock()  # Only one answer is sent at a time, although several threads can send answers.

    def answer(content: Any) -> None:
        with lock, suppress(BrokenPipeError):  # Writing fails if the run was killed.
            pickle.dump(content, stream)
            stream.flush()

    try:
        import_module(module).main(_requests(), answer)
    except Exception as error:
        answer(RuntimeError(reason_of(error)))


def _requests() -> Iterator[Any]:
    """Yield everything that the run sends, until the run has ended or was killed."""
    with suppress(EOFError, pickle.UnpicklingError):
        while True:
            yield pickle.load(sys.stdin.buffer)


def reason_of(error: BaseException) -> str:
    """Return what an exception says, in one line."""
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error) or repr(error)
    return " ".join(reason.split())
