"""Connect the loop to a process that answers robots, so that no robot waits for a tick."""

from __future__ import annotations

import pickle
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from subprocess import TimeoutExpired
from typing import Any

from q2r2_control.errors import PlantError
from q2r2_control.process.helper_process import start_python
from q2r2_control.process.scheduling import how_it_ended, thread_priority

_PATIENCE = 5.0  # Time to wait until the process ends [s].


class AnsweringProcess:
    """Starts a process that calls the function ``main(commands, states)`` of a module.

    Both arguments are file descriptors of sockets. Through the socket ``commands``, the process receives its priority
    and ``given``, and replies ``BEGUN``. It then replies to each command by ``TAKEN`` or ``TOO_LATE``. If it fails, it
    replies with the text of the error instead. Through the socket ``states`` it sends states, without waiting for the
    loop.
    """

    TAKEN, TOO_LATE, BEGUN = b"1", b"0", b"2"  # The replies to commands, and the first reply.
    LARGEST = 1 << 16  # Largest datagram between the processes [bytes].

    def __init__(
        self, module: str, robots: str, given: tuple[Any, ...], longest_word: float, files: Sequence[int] = ()
    ):
        """Start the process, and return when it has begun, which takes seconds on a busy computer.

        Args:
            module: The module with ``main``.
            robots: The robots that the process answers, in words, such as "the cabinets".
            given: Objects that the process receives after its priority.
            longest_word: Longest time to wait for the reply to a command [s].
            files: File descriptors that the process inherits.

        Raises:
            PlantError: If the process cannot begin.
        """
        self._robots, self._longest_word = robots, longest_word
        # States that nobody reads can fill their socket. Commands and replies therefore have another socket.
        self._commands, commands = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._states, states = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._states.setblocking(False)
        links = commands.fileno(), states.fileno()
        with commands, states:
            self._process = start_python(f"from {module} import main; main{links}", {}, files=[*links, *files])
        self.pid = self._process.pid
        # If the loop has a real-time priority, the process gets a higher priority. Otherwise, it gets the number 0.
        priority = thread_priority()
        self._commands.send(pickle.dumps((priority and priority + 1, *given)))
        word = b""
        with suppress(ConnectionError):
            word = self._commands.recv(self.LARGEST)
        if word != self.BEGUN:
            raise self._end(word)
        self._commands.settimeout(longest_word)

    def send(self, commands: Mapping[str, Any]) -> bool:
        """Send a command for each arm; returns whether all commands came in time. If not, no command is followed.

        Raises:
            PlantError: If the process has ended, or does not reply.
        """
        try:
            self._commands.send(pickle.dumps(commands))
            word = self._commands.recv(self.LARGEST)
        except TimeoutError as error:
            silent = f"the process that answers {self._robots} says nothing for {self._longest_word:g} s"
            raise PlantError(silent) from error
        except ConnectionError:
            word = b""
        if word not in (self.TAKEN, self.TOO_LATE):
            raise self._end(word)
        return word == self.TAKEN

    def said(self) -> Iterator[bytes]:
        """Yield the states, as bytes, that the process has sent since the previous call of this method.

        Raises:
            PlantError: If the process has ended.
        """
        with suppress(BlockingIOError):
            while said := self._states.recv(self.LARGEST):
                yield said
            raise self._end()

    def _end(self, last_word: bytes = b"") -> PlantError:
        """Return an error that says how the process has ended."""
        if not last_word:
            with suppress(OSError):
                last_word = self._commands.recv(self.LARGEST)
        if last_word:
            return PlantError(f"{self._robots} are answered no more: {last_word.decode()}")
        return PlantError(how_it_ended(f"the process that answers {self._robots}", self._process.wait(_PATIENCE)))

    def close(self) -> None:
        """Let the process end as soon as the arms stand still, and wait for its end. Kill it if this takes over 5 s."""
        self._commands.close()
        try:
            self._process.wait(_PATIENCE)
        except TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._states.close()
