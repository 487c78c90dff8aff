"""The process that answers the cabinets: it does nothing else, so that no tick of the loop makes a cabinet wait.

The loop sends commands, and gets the state of a session after each message of its cabinet. Where the loop has ended,
in whatever way, cabinets are answered until the arms have come to rest on their certified stop.
"""

from __future__ import annotations

import pickle
import select
import socket
import struct
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from subprocess import TimeoutExpired

from q2r2_control.errors import PlantError
from q2r2_control.plants.fri.session import ArmSession
from q2r2_control.plants.fri.session_state import ArmCommand, SessionState
from q2r2_control.plants.fri.wire import LONGEST, read_monitoring
from q2r2_control.process.helper_process import leave_signals_to_the_run, reason_of, start_python
from q2r2_control.process.scheduling import few_garbage_collections, how_it_ended, real_time, thread_priority

_LARGEST = 1 << 16  # of what is passed on [bytes]
_POLL = 50  # of looking whether the arms of a loop that has ended stand still [ms]
_PATIENCE = 5.0  # with a process that is to end [s]
# Linux stamps datagrams as they arrive (SO_TIMESTAMPNS) by its real-time clock; longer waits are jumps of that [s].
_TIMESTAMP, _TIMESPEC, _EXTRA, _LONGEST_WAIT = 35, struct.Struct("@qq"), 64, 0.1


@dataclass(slots=True)
class Line:
    """To one cabinet."""

    session: ArmSession
    address: str  # of the cabinet; nothing else is heard
    file: int  # of the socket
    newest: bytes | None = None  # message of the cabinet, as it came: that is passed on faster than read


class AnsweringProcess:
    """The loop's end."""

    def __init__(self, lines: Sequence[Line]) -> None:
        """With a line to each cabinet, of which this process may close its sockets then."""
        self._link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._link.setblocking(False)
        files = [theirs.fileno(), *(line.file for line in lines)]
        with theirs:
            self._process = start_python(f"from {__name__} import main; main({theirs.fileno()})", {}, files=files)
        self.pid = self._process.pid
        # An answer goes before the loop, where that has a priority.
        priority = thread_priority()
        self._link.send(pickle.dumps((priority and priority + 1, list(lines))))

    def send(self, packed: bytes) -> bool:
        """Whether pickled commands, by arm, will be taken before the next answer."""
        try:
            self._link.send(packed)
        except OSError:  # it stands still, or has ended, which :meth:`receive` says
            return False
        return True

    def receive(self) -> list[SessionState]:
        """The states that have come since the last call. Raises :class:`PlantError` where the process has ended."""
        states = []
        with suppress(BlockingIOError, ConnectionError):
            while True:
                said = pickle.loads(self._link.recv(_LARGEST))
                if isinstance(said, RuntimeError):
                    raise PlantError(f"the cabinets are answered no more: {said}")
                values, newest = said
                states.append(SessionState(**values | {"newest": newest and read_monitoring(newest)}))
        code = self._process.poll()
        if code is not None:
            raise PlantError(how_it_ended("the process that answers the cabinets", code))
        return states

    def close(self) -> None:
        """Let it end as soon as the arms stand still."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(_PATIENCE)
        except TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._link.close()


def main(link: int) -> None:
    """In the process: answer until the loop has ended and the arms stand still."""
    leave_signals_to_the_run()
    with socket.socket(fileno=link) as opened:
        try:
            priority, lines = pickle.loads(opened.recv(_LARGEST))
            opened.setblocking(False)
            with ExitStack() as stack:
                if priority:
                    stack.enter_context(real_time(priority))
                stack.enter_context(few_garbage_collections())
                _Answering(opened, lines).run()
        except Exception as error:
            opened.send(pickle.dumps(RuntimeError(reason_of(error))))


class _Answering:
    def __init__(self, link: socket.socket, lines: list[Line]) -> None:
        self._link = link
        self._sessions = {line.session.state.arm: line.session for line in lines}
        self._lines = {line.file: (line, socket.socket(fileno=line.file)) for line in lines}

    def run(self) -> None:
        poll, loop = select.poll(), sys.stdin.fileno()
        for file in (*self._lines, self._link.fileno()):
            poll.register(file, select.POLLIN)
        poll.register(loop, select.POLLHUP)
        for _, opened in self._lines.values():
            with suppress(OSError):
                while True:  # what came while this process began is too old to be answered
                    opened.recv(LONGEST + 1)
        ended = False
        while not (ended and all(session.is_still(time.monotonic()) for session in self._sessions.values())):
            for file, _ in poll.poll(_POLL):
                self._take_commands()
                if file == loop:
                    ended = True
                    poll.unregister(loop)
                elif file in self._lines:
                    self._answer(*self._lines[file])

    def _take_commands(self) -> None:
        """An answer goes by all that was sent before it."""
        with suppress(BlockingIOError):
            while True:
                commands: dict[str, ArmCommand] = pickle.loads(self._link.recv(_LARGEST))
                for arm, command in commands.items():
                    self._sessions[arm].follow(command)

    def _answer(self, line: Line, opened: socket.socket) -> None:
        session, state = line.session, line.session.state
        try:
            datagram, extra, _, source = opened.recvmsg(LONGEST + 1, _EXTRA)
            if source[0] != line.address:
                return
            came = time.monotonic() - _waited(extra)
            before, state.took = state.newest, None
            answer = session.answer(datagram, came)
            if state.newest is not before:
                line.newest = datagram
            if answer is not None:
                opened.sendto(answer, source)
                state.took = time.monotonic() - came
        except OSError:  # a cabinet that is gone refuses; its silence is noticed
            return
        with suppress(OSError):  # a loop that stands still gets a later state
            self._link.send(pickle.dumps((vars(state) | {"newest": None}, line.newest)))


def open_socket(address: str, port: int) -> socket.socket:
    """A socket for one cabinet: loopback where it is on this computer, else all of its networks. Raises OSError."""
    opened = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.bind((address if address in ("127.0.0.1", "::1") else "", port))
    except OSError:
        opened.close()
        raise
    opened.setblocking(False)
    opened.setsockopt(socket.SOL_SOCKET, _TIMESTAMP, 1)
    return opened


def _waited(extra: list[tuple[int, int, bytes]]) -> float:
    """How long ago the kernel received a datagram [s]; 0 where it does not say."""
    for _, kind, data in extra:
        if kind == _TIMESTAMP:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return min(max(time.time() - seconds - 1e-9 * nanoseconds, 0.0), _LONGEST_WAIT)
    return 0.0
