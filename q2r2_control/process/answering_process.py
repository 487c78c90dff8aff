"""The loop's end of the connection to a process that answers robots, so that no tick makes a robot wait."""

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
    """Starts a process by the function ``main(commands, states)`` of a module, whose arguments are two sockets' files.

    Through the first one the process gets its priority with ``given``, replies ``BEGUN``, and then replies to commands
    by ``TAKEN`` or ``TOO_LATE``. An error's text may take the place of each reply. Through the second one it sends
    states, and never waits for the loop.
    """

    TAKEN, TOO_LATE, BEGUN = b"1", b"0", b"2"  # The replies to commands, and the first reply.
    LARGEST = 1 << 16  # Largest datagram between the processes [bytes].

    def __init__(
        self, module: str, robots: str, given: tuple[Any, ...], longest_word: float, files: Sequence[int] = ()
    ):
        """Start the process, and return when it has begun, which takes seconds on a busy computer.

        Args:
            module: The module with ``main``.
            robots: What the process answers, in words, such as "the cabinets".
            given: What the process gets after its priority, which is above that of the loop, or None.
            longest_word: Time to wait for the reply to commands [s].
            files: Files that the process inherits.

        Raises:
            PlantError: If the process cannot begin.
        """
        self._robots, self._longest_word = robots, longest_word
        # States that nobody reads may fill their connection. Replies to commands must not wait for that.
        self._commands, commands = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._states, states = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._states.setblocking(False)
        links = commands.fileno(), states.fileno()
        with commands, states:
            self._process = start_python(f"from {module} import main; main{links}", {}, files=[*links, *files])
        self.pid = self._process.pid
        # If the loop has a real-time priority, answers come before it.
        priority = thread_priority()
        self._commands.send(pickle.dumps((priority and priority + 1, *given)))
        word = b""
        with suppress(ConnectionError):
            word = self._commands.recv(self.LARGEST)
        if word != self.BEGUN:
            raise self._end(word)
        self._commands.settimeout(longest_word)

    def send(self, commands: Mapping[str, Any]) -> bool:
        """Send a command for each arm; returns whether all of them came in time. If not, none of them is followed.

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
        """Yield what the process has sent about states since the last call.

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
        """Let the process end as soon as the arms stand still."""
        self._commands.close()
        try:
            self._process.wait(_PATIENCE)
        except TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._states.close()
