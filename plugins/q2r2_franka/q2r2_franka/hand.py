"""A Franka Hand in a process of its own, because a call of its library waits until the fingers have arrived.

The library has calls for whole motions, not for a stream of positions: ``move`` to a width, and ``grasp`` with a force.
The loop commands openings, from 0 for closed to 1 for open. When a motion has ended, the fingers move to the newest
commanded opening. Thus they follow a trigger in steps. If the hand is commanded to close, it grasps: the fingers then
hold whatever is between them, with the force of the grasp.
"""

from __future__ import annotations

import pickle
import socket
import time
from contextlib import suppress
from subprocess import TimeoutExpired
from typing import Any

from q2r2_control.process import leave_signals_to_the_run, start_python
from q2r2_franka.settings import HandSettings

_LARGEST = 1 << 10  # Largest datagram between the processes [bytes].
_CLOSED = 0.02  # If the commanded opening is smaller than this, the fingers grasp.
_SAME = 0.02  # If the commanded opening changes by less than this, the fingers do not move.
_MEASURES = 0.1  # Time between two measurements while the fingers do not move [s].
_KNOWN = 5.0  # A measured opening counts as known for this time [s]. During a motion there are no measurements.
_AGAIN = 1.0  # Time between two attempts to connect [s].
_PATIENCE = 2.0  # The process is killed if it has not ended after this time [s].


class Hand:
    """Starts the process of one hand, and exchanges messages with it. The loop uses this class.

    Only :meth:`close` waits.
    """

    def __init__(self, arm: str, address: str, settings: HandSettings) -> None:
        self._arm, self._commanded = arm, 1.0
        self._socket, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.setblocking(False)
        with other:
            code = f"from {__name__} import main; main({other.fileno()}, {address!r}, {settings.model_dump()!r})"
            self._process = start_python(code, {}, files=[other.fileno()])
        self._opening: float | None = None
        self._measured = 0.0

    def command(self, opening: float) -> None:
        """Let the fingers move to ``opening``, from 0 for closed to 1 for open."""
        if opening != self._commanded:
            with suppress(OSError):
                self._socket.send(pickle.dumps(opening))
                self._commanded = opening

    @property
    def opening(self) -> float | None:
        """The measured opening, from 0 for closed to 1 for open; None if it is not known."""
        with suppress(OSError):
            while said := self._socket.recv(_LARGEST):
                self._opening, self._measured = pickle.loads(said), time.monotonic()
        return self._opening if time.monotonic() - self._measured < _KNOWN else None

    def close(self) -> None:
        """End the process. The fingers stay where they are."""
        self._socket.close()
        try:
            self._process.wait(_PATIENCE)
        except TimeoutExpired:
            self._process.kill()
            self._process.wait()


def main(file: int, address: str, settings: dict[str, Any]) -> None:
    """Connect to the hand, and again after an error, and move the fingers until the loop has ended.

    The process runs this function.
    """
    import pylibfranka

    leave_signals_to_the_run()
    loop, its = socket.socket(fileno=file), HandSettings.model_validate(settings)
    with loop:
        while True:
            with suppress(RuntimeError, pylibfranka.FrankaException):
                gripper = pylibfranka.Gripper(address)
                if its.homes:
                    gripper.homing()
                    its = its.model_copy(update={"homes": False})
                if not _move(loop, gripper, its):
                    return
            if not _newest(loop, 1.0, _AGAIN)[1]:
                return


def _move(loop: socket.socket, gripper: Any, settings: HandSettings) -> bool:
    """Move the fingers to the commanded openings. Return False when the loop has ended.

    Raises an error of the library if a call fails.
    """
    there = wanted = gripper.read_once().width / settings.width
    while True:
        with suppress(BlockingIOError):
            loop.send(pickle.dumps(min(max(gripper.read_once().width / settings.width, 0.0), 1.0)))
        wanted, is_there = _newest(loop, wanted, _MEASURES)
        if not is_there:
            return False
        if abs(wanted - there) < _SAME and (wanted >= _CLOSED or there < _CLOSED):
            continue
        there = wanted
        if wanted < _CLOSED:
            gripper.grasp(0.0, settings.speed, settings.force, 0.0, settings.width)
        else:
            gripper.move(wanted * settings.width, settings.speed)


def _newest(loop: socket.socket, before: float, wait: float) -> tuple[float, bool]:
    """Wait at most ``wait`` [s] for a command. Return the newest commanded opening, or ``before`` if there is none.

    The second value is False if the loop has ended.
    """
    loop.settimeout(wait)
    try:
        while said := loop.recv(_LARGEST):
            before = pickle.loads(said)
            loop.settimeout(0.0)
    except (TimeoutError, BlockingIOError):
        return before, True
    except OSError:
        pass
    return before, False
