"""Answer the cabinets in a process of its own, so that no tick of the loop makes a cabinet wait.

The loop sends commands to this process, and gets back whether they came in time. After each message of a cabinet it
gets the state of the session. If the loop ends in any way, the process goes on until the arms have come to rest on
their certified stop.
"""

from __future__ import annotations

import pickle
import select
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from ipaddress import ip_address
from subprocess import TimeoutExpired

from q2r2_control.errors import PlantError
from q2r2_control.plants.fri.session import ArmSession, answer, follow
from q2r2_control.plants.fri.session_state import ArmCommand, SessionState
from q2r2_control.plants.fri.wire import LONGEST, read_monitoring
from q2r2_control.process.helper_process import leave_signals_to_the_run, reason_of, start_python
from q2r2_control.process.scheduling import few_garbage_collections, how_it_ended, real_time, reserve, thread_priority

_TAKEN, _TOO_LATE = b"1", b"0"  # The replies to commands.
_RESERVED = 0.0015, 0.002  # Processor time that is reserved for answers in each interval [s]. An answer takes 0.2 ms.
_BEGUN = b"2"  # The first reply, which says that the process hears the cabinets.
_LARGEST = 1 << 16  # Largest datagram between the processes [bytes].
_POLL = 0.05  # After the loop has ended, time between two looks whether the arms stand still [s].
_PATIENCE = 5.0  # Time to wait until the process ends [s].
_LONGEST_WORD = 1.0  # Time to wait for the reply to commands. Arms brake meanwhile [s].
# Linux stamps arriving datagrams by its real-time clock (SO_TIMESTAMPNS). A longer wait is a jump of that clock [s].
_TIMESTAMP, _TIMESPEC, _EXTRA, _LONGEST_WAIT = 35, struct.Struct("@qq"), 64, 0.1


@dataclass(slots=True)
class Line:
    """The connection to one cabinet."""

    session: ArmSession
    address: str  # Address of the cabinet. Datagrams from other addresses are ignored.
    file: int  # File descriptor of the socket.
    newest: bytes | None = None  # The newest message of the cabinet, which the process passes on without decoding it.


class AnsweringProcess:
    """The loop's end of the connection to the process."""

    def __init__(self, lines: Sequence[Line]) -> None:
        """Start the process, with a line to each cabinet. The caller may close its own sockets then.

        It returns when the process hears the cabinets, which takes seconds on a busy computer.

        Raises:
            PlantError: If the process cannot begin.
        """
        # States that nobody reads may fill their connection. Replies to commands must not wait for that.
        self._commands, commands = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._states, states = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._states.setblocking(False)
        links = commands.fileno(), states.fileno()
        with commands, states:
            code, files = f"from {__name__} import main; main{links}", [*links, *(line.file for line in lines)]
            self._process = start_python(code, {}, files=files)
        self.pid = self._process.pid
        # If the loop has a real-time priority, answers come before it.
        priority = thread_priority()
        self._commands.send(pickle.dumps((priority and priority + 1, list(lines))))
        word = b""
        with suppress(ConnectionError):
            word = self._commands.recv(_LARGEST)
        if word != _BEGUN:
            raise self._end(word)
        self._commands.settimeout(_LONGEST_WORD)

    def send(self, commands: dict[str, ArmCommand]) -> bool:
        """Send a command for each arm; returns whether all of them came in time. If not, none of them is followed.

        Raises:
            PlantError: If the process has ended, or does not reply.
        """
        try:
            self._commands.send(pickle.dumps(commands))
            word = self._commands.recv(_LARGEST)
        except TimeoutError as error:
            raise PlantError(f"the process that answers the cabinets says nothing for {_LONGEST_WORD:g} s") from error
        except ConnectionError:
            word = b""
        if word not in (_TAKEN, _TOO_LATE):
            raise self._end(word)
        return word == _TAKEN

    def receive(self) -> tuple[list[SessionState], list[tuple[float, float]]]:
        """Return each arm's newest state since the last call, and for each message its arrival and answer time [s].

        Raises:
            PlantError: If the process has ended.
        """
        newest, answers = {}, []
        with suppress(BlockingIOError):
            while said := self._states.recv(_LARGEST):
                values, datagram = pickle.loads(said)
                newest[values["arm"]] = values, datagram  # After a late tick only the newest message is decoded.
                if values["took"] is not None:
                    answers.append((values["arrival"], values["took"]))
            raise self._end()
        return [SessionState(**its | {"newest": raw and read_monitoring(raw)}) for its, raw in newest.values()], answers

    def _end(self, last_word: bytes = b"") -> PlantError:
        """Return an error that says how the process has ended."""
        if not last_word:
            with suppress(OSError):
                last_word = self._commands.recv(_LARGEST)
        if last_word:
            return PlantError(f"the cabinets are answered no more: {last_word.decode()}")
        return PlantError(how_it_ended("the process that answers the cabinets", self._process.wait(_PATIENCE)))

    def close(self) -> None:
        """Let the process end as soon as the arms stand still."""
        self._commands.close()
        try:
            self._process.wait(_PATIENCE)
        except TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._states.close()


def main(commands: int, states: int) -> None:
    """Run in the process: answer until the loop has ended and the arms stand still."""
    leave_signals_to_the_run()
    with socket.socket(fileno=commands) as from_loop, socket.socket(fileno=states) as to_loop:
        try:
            priority, lines = pickle.loads(from_loop.recv(_LARGEST))
            from_loop.setblocking(False)
            to_loop.setblocking(False)
            with ExitStack() as stack:
                if priority:
                    stack.enter_context(real_time(priority))
                    reserve(*_RESERVED)
                stack.enter_context(few_garbage_collections())
                _Answering(from_loop, to_loop, lines).run()
        except Exception as error:
            from_loop.send(reason_of(error).encode())


class _Answering:
    def __init__(self, commands: socket.socket, states: socket.socket, lines: list[Line]) -> None:
        self._commands, self._states = commands, states
        self._sessions = {line.session.state.arm: line.session for line in lines}
        self._lines = {line.file: (line, socket.socket(fileno=line.file)) for line in lines}

    def run(self) -> None:
        files = [*self._lines, self._commands.fileno()]
        for _, opened in self._lines.values():
            with suppress(OSError):
                while True:  # Messages that came while this process started are too old to be answered.
                    opened.recv(LONGEST + 1)
        self._commands.send(_BEGUN)
        ended = False
        while not (ended and all(session.is_still(time.monotonic()) for session in self._sessions.values())):
            for file in select.select(files, (), (), _POLL)[0]:
                if not (ended or self._take_commands()):
                    ended = True
                    files.remove(self._commands.fileno())
                if file in self._lines:
                    self._answer(*self._lines[file])

    def _take_commands(self) -> bool:
        """Take all commands before an answer; returns whether the loop is still there."""
        try:
            while said := self._commands.recv(_LARGEST):
                self._commands.send(_TAKEN if follow(self._sessions, pickle.loads(said)) else _TOO_LATE)
        except BlockingIOError:
            return True
        except ConnectionError:
            pass
        return False

    def _answer(self, line: Line, opened: socket.socket) -> None:
        state = line.session.state
        try:
            datagram, extra, _, source = opened.recvmsg(LONGEST + 1, _EXTRA)
            if source[0] != line.address:
                return
            came = time.monotonic() - _waited(extra)
            before, state.took = state.newest, None
            reply = answer(self._sessions, state.arm, datagram, came)
            if state.newest is not before:
                line.newest = datagram
            if reply is not None:
                opened.sendto(reply, source)
                state.took = time.monotonic() - came
        except OSError:  # The cabinet has gone. Its silence will be noticed.
            return
        with suppress(OSError):  # A loop that stands still gets a later state.
            self._states.send(pickle.dumps((vars(state) | {"newest": None}, line.newest)))


def address_for(cabinet: str) -> str:
    """Return the address to which a ``cabinet`` on this computer sends; "" for a cabinet elsewhere, on any network."""
    if not ip_address(cabinet).is_loopback:
        return ""
    return "::1" if ":" in cabinet else "127.0.0.1"


def open_socket(address: str, port: int) -> socket.socket:
    """Open a socket for one cabinet, on loopback if it is on this computer, else on all networks; may raise OSError."""
    opened = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.bind((address_for(address), port))
    except OSError:
        opened.close()
        raise
    opened.setblocking(False)
    opened.setsockopt(socket.SOL_SOCKET, _TIMESTAMP, 1)
    return opened


def _waited(extra: list[tuple[int, int, bytes]]) -> float:
    """Return the time since the kernel received a datagram [s]; 0 if the kernel does not say."""
    for _, kind, data in extra:
        if kind == _TIMESTAMP:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return min(max(time.time() - seconds - 1e-9 * nanoseconds, 0.0), _LONGEST_WAIT)
    return 0.0
