"""Cabinets on real sockets, which wait for each answer: a client on a busy machine is never late."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from q2r2_control.config.cell import Config
from q2r2_control.plants.fri.cabinet import Cabinet, StillArm
from q2r2_control.plants.fri.cabinet_server import settings_of
from q2r2_control.plants.fri.wire import CommandKind, write_monitoring
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES

_PERIOD = 0.005  # [s]
_LOOKS = 0.02  # between two messages to a client that is not there, and two looks at the end [s]


@contextmanager
def waiting_cabinets(robot: Robot, config: Config, version: int = 2) -> Iterator[dict[str, Cabinet]]:
    """One for each arm, in a thread; each has started its overlay."""
    made, done = {}, threading.Event()
    for arm in SIDES:
        settings = settings_of(robot, arm, CommandKind.POSITION, version, _PERIOD)
        made[arm] = Cabinet(settings, StillArm(tuple(robot.home[robot.arms[arm].joints])))
        made[arm].start_overlay()

    def answer_to(opened: socket.socket, heard: bool) -> bytes | None:
        while not done.is_set():
            try:
                return opened.recv(2000)
            except TimeoutError:
                if not heard:
                    break
            except OSError:  # nobody listens there
                done.wait(_LOOKS)
                break
        return None

    def serve(cabinet: Cabinet, port: int) -> None:
        heard, due = False, time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
            opened.bind(("127.0.0.1", 0))
            opened.settimeout(_LOOKS)
            while not done.wait(max(due - time.monotonic(), 0.0)):
                due += _PERIOD
                opened.sendto(write_monitoring(cabinet.send(0.0)), ("127.0.0.1", port))
                if (answer := answer_to(opened, heard)) is not None:
                    cabinet.receive(answer)
                    heard = True
                else:
                    due = time.monotonic()

    threads = [threading.Thread(target=serve, args=(made[arm], its.port)) for arm, its in config.fri.items()]
    for thread in threads:
        thread.start()
    try:
        yield made
    finally:
        done.set()
        for thread in threads:
            thread.join()
