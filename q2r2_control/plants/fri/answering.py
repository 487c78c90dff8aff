"""Answer the cabinets in a process of its own, so that no tick of the loop makes a cabinet wait.

The loop sends commands to this process, and gets back whether they came in time. After each message of a cabinet the
loop gets the state of the session. However the loop ends, the process goes on until the arms have come to rest at the
end of their certified stop.
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

from q2r2_control.plants.fri.session import ArmSession, answer, follow
from q2r2_control.plants.fri.session_state import SessionState
from q2r2_control.plants.fri.wire import LONGEST, read_monitoring
from q2r2_control.process.answering_process import AnsweringProcess
from q2r2_control.process.helper_process import leave_signals_to_the_run, reason_of
from q2r2_control.process.scheduling import few_garbage_collections, real_time, reserve

# Processor time that is reserved for answers in each interval, and the length of an interval [s]. An answer takes
# 0.2 ms.
_RESERVED = 0.0015, 0.002
_POLL = 0.05  # Time between two checks whether the arms stand still, after the loop has ended [s].
_LONGEST_REPLY_WAIT = 1.0  # Longest time that the loop waits for the reply to its commands [s].
# The socket option SO_TIMESTAMPNS, by which Linux stamps each arriving datagram with its real-time clock; the layout of
# such a stamp; the size of the buffer for the stamp [bytes]; and the longest time that a datagram can have waited [s].
# If the stamp shows a longer wait, the real-time clock has jumped.
_TIMESTAMP, _TIMESPEC, _EXTRA, _LONGEST_WAIT = 35, struct.Struct("@qq"), 64, 0.1


@dataclass(slots=True)
class Line:
    """The connection to one cabinet."""

    session: ArmSession
    address: str  # Address of the cabinet. Datagrams from other addresses are ignored.
    file: int  # File descriptor of the socket.
    # The cabinet's newest message, or None before the first one. The process sends it to the loop without decoding it.
    newest: bytes | None = None


class CabinetAnswers(AnsweringProcess):
    """The loop's end of the connection to the process that answers the cabinets."""

    def __init__(self, lines: Sequence[Line]) -> None:
        """Start the process, which takes over the connections ``lines`` to the cabinets.

        The process gets a copy of each socket, so that the caller may then close its own sockets.

        Raises:
            PlantError: If the process cannot be started.
        """
        files = [line.file for line in lines]
        super().__init__(__name__, "the cabinets", (list(lines),), _LONGEST_REPLY_WAIT, files)

    def receive(self) -> tuple[list[SessionState], list[tuple[float, float]]]:
        """Return the newest states of the sessions, and two times for each message that was answered.

        Both contain only data that have come since the previous call of this method. The two times are the message's
        arrival by the monotonic clock, and the time from its arrival until its answer was sent [s].

        Raises:
            PlantError: If the process has ended.
        """
        newest, answers = {}, []
        for said in self.said():
            values, datagram = pickle.loads(said)
            newest[values["arm"]] = values, datagram  # If several messages have come, only the newest one is decoded.
            if values["took"] is not None:
                answers.append((values["arrival"], values["took"]))
        return [SessionState(**its | {"newest": raw and read_monitoring(raw)}) for its, raw in newest.values()], answers


def main(commands: int, states: int) -> None:
    """Run the process: answer the cabinets until the loop has ended and the arms stand still.

    Args:
        commands: File descriptor of the socket from which the loop's commands come.
        states: File descriptor of the socket to which the states of the sessions are sent.
    """
    leave_signals_to_the_run()
    with socket.socket(fileno=commands) as from_loop, socket.socket(fileno=states) as to_loop:
        try:
            priority, lines = pickle.loads(from_loop.recv(CabinetAnswers.LARGEST))
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
                # Messages that came while this process started are dropped, because they are too old to be answered.
                while True:
                    opened.recv(LONGEST + 1)
        self._commands.send(CabinetAnswers.BEGUN)
        ended = False
        while not (ended and all(session.is_still(time.monotonic()) for session in self._sessions.values())):
            for file in select.select(files, (), (), _POLL)[0]:
                if not (ended or self._take_commands()):
                    ended = True
                    files.remove(self._commands.fileno())
                if file in self._lines:
                    self._answer(*self._lines[file])

    def _take_commands(self) -> bool:
        """Take all commands that have come from the loop; returns False if the loop has ended."""
        try:
            while said := self._commands.recv(CabinetAnswers.LARGEST):
                self._commands.send(
                    CabinetAnswers.TAKEN if follow(self._sessions, pickle.loads(said)) else CabinetAnswers.TOO_LATE
                )
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
        except OSError:  # The cabinet cannot be reached. The loop notices that the cabinet is silent.
            return
        with suppress(OSError):  # If the loop stalls, the socket has no space for this state. A later state follows.
            self._states.send(pickle.dumps((vars(state) | {"newest": None}, line.newest)))


def address_for(cabinet: str) -> str:
    """Return the address of this computer on which the messages of ``cabinet`` are received.

    It is the loopback address if the cabinet is on this computer, otherwise "", which means all networks.
    """
    if not ip_address(cabinet).is_loopback:
        return ""
    return "::1" if ":" in cabinet else "127.0.0.1"


def open_socket(address: str, port: int) -> socket.socket:
    """Open a socket for one cabinet: on loopback if the cabinet is on this computer, otherwise on all networks.

    Raises:
        OSError: If the port cannot be bound.
    """
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
    """Return the time since the kernel received a datagram [s]; 0 if the datagram has no stamp of the kernel."""
    for _, kind, data in extra:
        if kind == _TIMESTAMP:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return min(max(time.time() - seconds - 1e-9 * nanoseconds, 0.0), _LONGEST_WAIT)
    return 0.0
