"""The process that answers the cabinets obeys the loop's commands. The process and the loop notice each other's end."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from q2r2_control.errors import PlantError
from q2r2_control.plants.fri.answering import CabinetAnswers, Line, open_socket
from q2r2_control.plants.fri.session import ArmSession
from q2r2_control.plants.fri.session_state import ArmCommand, SessionState
from q2r2_control.plants.fri.wire import FriCommand, Monitoring, Quality, Session, read_command, write_monitoring
from tests.support.headset_server import eventually

Q = (0.0, 0.5, 0.0, -1.2, 0.0, 1.0, 0.0)
ANSWERS = 50
STILL, ONES = (0.0,) * 7, (1.0,) * 7
IO = {"Gripper.Opening": 1.0}
MONITORING = Monitoring(2, 1, 0, Session.MONITORING_READY, Quality.EXCELLENT, 0.005, 1, Q, io=IO, outputs=frozenset(IO))


class LongMotion(ArmSession):
    """A session whose arm stands still after ``answers`` messages."""

    def __init__(self, answers: int) -> None:
        super().__init__("left", "cabinet")
        self._left = answers

    def answer(self, datagram: bytes, now: float) -> bytes | None:
        self._left -= 1
        return super().answer(datagram, now)

    def is_still(self, now: float) -> bool:
        return self._left <= 0


class BrokenOnTheWay(ArmSession):
    """A session that the process cannot unpickle."""

    def __setstate__(self, state: object) -> None:
        raise ValueError("it came broken")


class Between:
    """The process that answers cabinets. The test takes the roles of its cabinet and of its loop."""

    def __init__(self, session: ArmSession) -> None:
        self.cabinet = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.cabinet.bind(("127.0.0.1", 0))
        ours = open_socket("127.0.0.1", 0)
        self.address, self.sent = ours.getsockname(), 0
        file = ours.detach()
        self.process = CabinetAnswers([Line(session, "127.0.0.1", file)])
        socket.close(file)
        self.states: list[SessionState] = []
        self.cabinet.settimeout(20.0)

    def ask(self) -> FriCommand:
        self.sent += 1
        self.cabinet.sendto(write_monitoring(replace(MONITORING, counter=self.sent)), self.address)
        return read_command(self.cabinet.recv(2000))[1]

    def hear(self) -> bool:
        self.states += self.process.receive()[0]
        return bool(self.states) and self.states[-1].newest == replace(MONITORING, counter=self.sent)


@contextmanager
def between_of(session: ArmSession) -> Iterator[Between]:
    made = Between(session)
    try:
        yield made
    finally:
        made.process.close()
        made.cabinet.close()


@pytest.fixture
def between() -> Iterator[Between]:
    with between_of(ArmSession("left", "cabinet")) as made:
        yield made


def test_the_process_answers_as_soon_as_its_creation_returns(between: Between) -> None:
    assert between.ask().reflected == 1, "messages that came before it had begun would be dropped"


def test_the_error_of_a_process_that_cannot_begin_contains_the_reason() -> None:
    with open_socket("127.0.0.1", 0) as ours, pytest.raises(PlantError, match="answered no more: it came broken"):
        CabinetAnswers([Line(BrokenOnTheWay("left", "cabinet"), "127.0.0.1", ours.fileno())])


def test_the_loop_gets_the_state_after_each_message_and_an_answer_uses_the_last_command(
    between: Between,
) -> None:
    between.ask()
    eventually(between.hear)
    assert between.states[-1].took is not None
    command = ArmCommand(0.0, 0.0, 0.001, Q, STILL, ONES, {"Gripper.Opening": 0.5})
    assert between.process.send({"left": command})
    assert between.ask().io == {"Gripper.Opening": 0.5}


@pytest.mark.slow
def test_messages_from_other_addresses_are_not_answered(between: Between) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.2", 0))
        other.settimeout(0.2)
        other.sendto(write_monitoring(replace(MONITORING, counter=between.sent + 1)), between.address)
        between.ask()
        with pytest.raises(TimeoutError):
            other.recv(2000)


def test_the_process_ends_when_the_loop_ends(between: Between) -> None:
    between.process.close()
    with pytest.raises(ProcessLookupError):
        os.kill(between.process.pid, 0)


@pytest.mark.slow
def test_the_process_goes_on_after_the_end_of_the_loop_until_the_arms_rest() -> None:
    with between_of(LongMotion(ANSWERS)) as between:
        between.process._commands.close()  # If the loop's process ends, this pipe is closed in the same way.
        while between.sent < ANSWERS:
            assert between.ask().reflected == between.sent
        between.process.close()
    with pytest.raises(ProcessLookupError):
        os.kill(between.process.pid, 0)


def test_a_loop_whose_process_was_killed_gets_a_fault(between: Between) -> None:
    os.kill(between.process.pid, signal.SIGKILL)

    def is_told() -> bool:
        try:
            between.process.receive()
        except PlantError as error:
            return "the process that answers the cabinets" in str(error)
        return False

    eventually(is_told)
    with pytest.raises(PlantError, match="the process that answers the cabinets"):
        between.process.send({})


def test_the_error_of_a_process_that_fails_contains_the_reason(between: Between) -> None:
    with pytest.raises(PlantError, match="the cabinets are answered no more: 'middle'"):
        between.process.send({"middle": ArmCommand(0.0, 0.0, 0.001, STILL, STILL, ONES)})
