"""Cabinets on real sockets that wait for each answer, so that a client on a busy machine is never late."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from q2r2_control.config.cell import Config
from q2r2_control.plants.fri.cabinet import Cabinet, StillArm
from q2r2_control.plants.fri.cabinet_server import settings_of
from q2r2_control.plants.fri.wire import CommandKind, write_monitoring
from q2r2_control.process.scheduling import schedule_thread_first
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES

_PRIORITY = 41  # The priority is above the loop's priority, because a real cabinet does not wait for the computer.
_LOOKS = 0.02  # Time between two messages to an absent client, and between two checks for the end [s].
_GONE = 1.0  # If no answer comes for this time, the client has probably ended before it read the message [s].


@contextmanager
def waiting_cabinets(
    robot: Robot, config: Config, version: int = 2, period: float = 0.005
) -> Iterator[dict[str, Cabinet]]:
    """Run a cabinet for each arm in a thread.

    Each cabinet sends every ``period`` [s], and starts its overlay whenever it may.
    """
    made, done = {}, threading.Event()
    for arm in SIDES:
        settings = settings_of(robot, arm, CommandKind.POSITION, version, period)
        made[arm] = Cabinet(settings, StillArm(tuple(robot.home[robot.arms[arm].joints])))

    def answer_to(opened: socket.socket) -> bytes | None:
        end = time.monotonic() + _GONE
        while not done.is_set() and time.monotonic() < end:
            try:
                return opened.recv(2000)
            except TimeoutError:
                continue
            except OSError:  # No program listens at the client's address.
                done.wait(_LOOKS)
                break
        return None

    def serve(cabinet: Cabinet, address: str, port: int) -> None:
        schedule_thread_first(_PRIORITY)  # If the system refuses this priority, the thread keeps its scheduler.
        due = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
            opened.bind((address, 0))
            opened.connect(("127.0.0.1", port))
            opened.settimeout(_LOOKS)
            while not done.wait(max(due - time.monotonic(), 0.0)):
                due += period
                cabinet.start_overlay()
                with suppress(OSError):  # The error belongs to the last message, which no program received.
                    opened.send(write_monitoring(cabinet.send(0.0)))
                if (answer := answer_to(opened)) is not None:
                    cabinet.receive(answer)
                else:
                    due = time.monotonic()

    served = [(made[arm], its.address, its.port) for arm, its in config.fri.items()]
    threads = [threading.Thread(target=serve, args=its) for its in served]
    for thread in threads:
        thread.start()
    try:
        yield made
    finally:
        done.set()
        for thread in threads:
            thread.join()
