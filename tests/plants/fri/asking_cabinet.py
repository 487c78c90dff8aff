"""A cabinet that sends messages to one session, one by one."""

from __future__ import annotations

from dataclasses import replace

from q2r2_control.plants.fri.session import ArmSession
from q2r2_control.plants.fri.wire import (
    CommandKind,
    FriCommand,
    Monitoring,
    Quality,
    Session,
    read_command,
    write_monitoring,
)

Q = (0.0, 0.5, 0.0, -1.2, 0.0, 1.0, 0.0)
IPO = (0.0, 0.501, 0.0, -1.2, 0.0, 1.0, 0.0)
MONITORING = Monitoring(2, 1, 0, Session.MONITORING_READY, Quality.EXCELLENT, 0.005, 1, Q)
WAITING = replace(MONITORING, session=Session.COMMANDING_WAIT, command=CommandKind.POSITION, ipo_q=IPO)
ACTIVE = replace(WAITING, session=Session.COMMANDING_ACTIVE)


class Cabinet:
    """A cabinet that sends messages 5 ms apart to a session, and reads the answers."""

    def __init__(self, session: ArmSession | None = None) -> None:
        self.session, self.sent, self.heard = session or ArmSession("left", "cabinet"), 0, 0
        self.silence = 0.0  # Duration of the silence so far [s].

    @property
    def now(self) -> float:
        return 0.005 * self.sent + self.silence

    def ask(self, message: Monitoring, lost: bool = False, doubled: bool = False) -> FriCommand | None:
        """Send a message and read the answer.

        If ``lost``, the answer is lost. If ``doubled``, the message comes twice.
        """
        self.sent += 1
        datagram = write_monitoring(replace(message, counter=self.sent, reflected=self.heard))
        for late in (0.0, 0.002)[: 1 + doubled]:
            answer = self.session.answer(datagram, self.now + late)
        if answer is None:
            return None
        command = read_command(answer)[1]
        self.heard = self.heard if lost else command.counter
        return command
