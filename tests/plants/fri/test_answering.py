"""The process that answers the cabinets: it ends with the loop, and the loop knows when it has ended."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator

import numpy as np
import pytest

from q2r2_control.errors import PlantError
from q2r2_control.plants.fri.answering import AnsweringProcess, Line, open_socket
from q2r2_control.plants.fri.session import ArmSession
from q2r2_control.plants.fri.session_state import ArmCommand, SessionState
from q2r2_control.plants.fri.wire import Monitoring, Quality, Session, read_command, write_monitoring
from tests.support.waiting import eventually

Q = (0.0, 0.5, 0.0, -1.2, 0.0, 1.0, 0.0)
MONITORING = Monitoring(2, 1, 0, Session.MONITORING_READY, Quality.EXCELLENT, 0.005, 1, Q)


class Ends:
    """The process between one cabinet and the loop."""

    def __init__(self) -> None:
        self.cabinet = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.cabinet.settimeout(10.0)
        ours = open_socket("127.0.0.1", 0)
        self.address, self.sent = ours.getsockname(), 0
        file = ours.detach()
        self.process = AnsweringProcess([Line(ArmSession("left", "cabinet"), "127.0.0.1", file)])
        socket.close(file)
        self.state: SessionState | None = None
        eventually(lambda: self.ask() is not None)  # what comes before it has begun is dropped

    def ask(self) -> object:
        """The answer to the next message, or None while there is none."""
        self.sent += 1
        self.cabinet.sendto(write_monitoring(MONITORING.__class__(2, self.sent, *vars_of(MONITORING)[2:])), self.address)
        self.cabinet.settimeout(0.2 if self.state is None else 10.0)
        try:
            answer = read_command(self.cabinet.recv(2000))[1]
        except TimeoutError:
            return None
        eventually(self.hear)
        return answer

    def hear(self) -> bool:
        for state in self.process.receive():
            self.state = state
        return self.state is not None
