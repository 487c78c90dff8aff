"""Answer the robots in a process of its own, so that a robot need not wait for a tick of the loop.

The loop sends commands to this process. The process replies whether the commands came in time. After each state of a
robot, it sends the state of the robot's session to the loop. Whatever ends the loop, the process goes on until the arms
have come to rest by their certified stops.
"""

from __future__ import annotations

import os
import pickle
import select
import socket
import time
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from typing import BinaryIO

import numpy as np

from q2r2_control import Array, CommandMode, PlantError
from q2r2_control.process import (
    AnsweringProcess,
    few_garbage_collections,
    leave_signals_to_the_run,
    real_time,
    reason_of,
    reserve,
)
from q2r2_franka.check import ARMS
from q2r2_franka.limits import JOINTS
from q2r2_franka.link import ERRORS, ArmLink
from q2r2_franka.record import Entry, write_entry
from q2r2_franka.session import ArmSession, ahead_of_others, follow
from q2r2_franka.settings import FrankaSettings
from q2r2_franka.state import Mode, SessionState

_RESERVED = 0.0006, 0.001  # Processor time that is reserved for answers, and the interval in which it is reserved [s].
_POLL = 0.01  # Longest time between two checks of all sessions [s].
# Longest time that the loop waits for the reply to its commands [s]. The process may be busy connecting a robot.
_LONGEST_WORD = 5.0
_AGAIN = 0.5  # Time from the end of a motion, or from a failed start, until the robots are started again [s].


class RobotAnswers(AnsweringProcess):
    """Starts the process that answers the robots, and exchanges messages with it. The loop uses this class."""

    def __init__(self, settings: FrankaSettings, mode: CommandMode, torque_limits: Mapping[str, Array]) -> None:
        """Start the process, which connects to the robots later.

        Raises:
            PlantError: If the process cannot begin.
        """
        super().__init__(__name__, "the robots", (settings, mode, dict(torque_limits)), _LONGEST_WORD)

    def receive(self) -> list[SessionState]:
        """Return each arm's newest state since the last call.

        Raises:
            PlantError: If the process has ended.
        """
        newest = {said[0]: said for said in self.said()}  # After a late tick only the newest state is decoded.
        return [pickle.loads(said[1:]) for said in newest.values()]


def main(commands: int, states: int) -> None:
    """Answer the robots until the loop has ended and the arms are at rest. The process runs this function."""
    leave_signals_to_the_run()
    with socket.socket(fileno=commands) as from_loop, socket.socket(fileno=states) as to_loop:
        try:
            priority, settings, mode, torque_limits = pickle.loads(from_loop.recv(RobotAnswers.LARGEST))
            from_loop.setblocking(False)
            to_loop.setblocking(False)
            with ExitStack() as stack:
                if priority:
                    stack.enter_context(real_time(priority))
                    reserve(*_RESERVED)
                stack.enter_context(few_garbage_collections())
                record = stack.enter_context(_opened(settings.record)) if settings.record else None
                _Answering(from_loop, to_loop, settings, mode, torque_limits, record).run()
        except Exception as error:
            with suppress(OSError):
                from_loop.send(reason_of(error).encode())
    # The process ends without running destructors, because the library's destructors would wait for lost robots.
    os._exit(0)


def _opened(record: str) -> BinaryIO:
    """Open the file for every command. Raises :class:`PlantError` if this is not possible."""
    try:
        return open(record, "wb")
    except OSError as error:
        raise PlantError(
            f"plant_settings.franka.record = {record}: {reason_of(error)}; allowed: a file in a folder that exists"
        ) from error


class _Answering:
    """Receives the loop's commands and the robots' states, and sends each robot its command."""

    def __init__(
        self,
        commands: socket.socket,
        states: socket.socket,
        settings: FrankaSettings,
        mode: CommandMode,
        torque_limits: Mapping[str, Array],
        record: BinaryIO | None,
    ) -> None:
        self._commands, self._states, self._mode, self._record = commands, states, mode, record
        self._arms = list(settings.arms)
        enforces = settings.real_time == "enforce"
        self._links = {arm: ArmLink(its, enforces) for arm, its in settings.arms.items()}
        self._sessions = {
            arm: ArmSession(arm, its.address, mode, torque_limits[arm]) for arm, its in settings.arms.items()
        }
        self._next_attempt = 0.0
        # Arms whose robots refused a motion, for example because of an error in an earlier motion.
        self._refused: set[str] = set()
        self._loop_ended = False

    def run(self) -> None:
        self._commands.send(RobotAnswers.BEGUN)
        while True:
            files = {link.file: arm for arm, link in self._links.items() if link.is_open}
            waits = [*files] if self._loop_ended else [*files, self._commands.fileno()]
            ready = select.select(waits, (), (), _POLL)[0]
            if not self._loop_ended and not self._take_commands():
                self._loop_ended = True
                self._brake_all()
            for file in ready:
                if file in files:
                    self._answer(files[file])
            if self._tend(time.monotonic()):
                return

    def _take_commands(self) -> bool:
        """Take all commands that have come, and reply to them. Return False if the loop has ended."""
        try:
            while said := self._commands.recv(RobotAnswers.LARGEST):
                self._commands.send(
                    RobotAnswers.TAKEN if follow(self._sessions, pickle.loads(said)) else RobotAnswers.TOO_LATE
                )
        except BlockingIOError:
            return True
        except ConnectionError:
            pass
        return False

    def _answer(self, arm: str) -> None:
        """Read the newest state of a robot, and send its command."""
        session, link = self._sessions[arm], self._links[arm]
        came = time.monotonic()
        try:
            measured = link.read()
            session.hear(measured, came)
            if session.state.controlled:
                values = session.answer(came, ahead_of_others(self._sessions, arm, came))
                link.write(values.tolist())
                session.state.took = time.monotonic() - came
                self._write(arm, values)
        except ERRORS as error:
            self._lost(arm, error)
        self._tell(arm)

    def _write(self, arm: str, values: Array, begins: bool = False) -> None:
        """Add ``values`` (7,) to the record: a command, or, if ``begins`` is True, the values when a motion begins."""
        newest = self._sessions[arm].state.newest
        if self._record is not None and newest is not None:
            is_torque = self._mode is CommandMode.TORQUE
            held = np.array(newest.held_tau if is_torque else newest.held)
            entry = Entry(ARMS.index(arm), begins, is_torque, newest.cycles, time.monotonic(), values, held)
            write_entry(self._record, entry)

    def _tell(self, arm: str) -> None:
        with suppress(OSError):  # The socket is full if the loop reads too slowly. This state is then dropped.
            self._states.send(bytes([self._arms.index(arm)]) + pickle.dumps(self._sessions[arm].state))

    def _lost(self, arm: str, error: Exception) -> None:
        """Store that a robot has ended its motion, or that its connection is lost. Then brake all arms."""
        link, session = self._links[arm], self._sessions[arm]
        session.end(reason_of(error))
        link.drop_motion()
        if type(error).__name__ == "NetworkException":
            self._lose(arm)
        self._brake_all()

    def _lose(self, arm: str) -> None:
        """Drop a lost connection. The last state stays, because the loop needs a state at every tick.

        The mode in this state becomes ABSENT.
        """
        self._links[arm].lose()
        if (newest := self._sessions[arm].state.newest) is not None:
            newest.mode = Mode.ABSENT

    def _brake_all(self) -> None:
        now = time.monotonic()
        self._next_attempt = now + _AGAIN
        for session in self._sessions.values():
            session.brake(now)

    def _tend(self, now: float) -> bool:
        """End sessions whose robots are silent, end the motions of arms at rest, and start the robots again.

        Returns:
            True if the loop has ended and all arms are at rest.
        """
        for arm, session in self._sessions.items():
            if session.state.controlled and session.state.is_silent(now):
                session.end("no state for a while")
                self._links[arm].drop_motion()
                self._brake_all()
        controlled = [session.state.controlled for session in self._sessions.values()]
        if all(controlled) and not self._loop_ended:
            return False
        if not all(session.is_still(now) for session in self._sessions.values()):
            return False
        self._finish()
        if self._loop_ended:
            return True
        if now >= self._next_attempt:
            self._begin(now)
        return False

    def _finish(self) -> None:
        """End the motions of all arms, which are at rest. Afterwards each robot holds its arm by itself."""
        for arm, session in self._sessions.items():
            if session.state.controlled:
                try:
                    measured = self._links[arm].read()
                    session.hear(measured, time.monotonic())
                    values = session.answer(time.monotonic(), 0.0)
                    self._links[arm].write(values.tolist(), finished=True)
                    self._write(arm, values)
                    session.end(session.state.problem)
                except ERRORS as error:
                    self._lost(arm, error)
                self._tell(arm)

    def _begin(self, now: float) -> None:
        """Connect, recover and start the robots. These calls may wait, because no arm moves meanwhile."""
        self._next_attempt = now + _AGAIN
        try:
            for arm, link in self._links.items():
                session = self._sessions[arm]
                if link.is_open and session.state.is_silent(now) and not select.select([link.file], (), (), 0)[0]:
                    self._lose(arm)  # The robot is silent, so its control has lost its power or its network.
                if not link.is_open:
                    link.open()
                    session.hear(link.read(), time.monotonic())
                newest = session.state.newest
                if newest is not None and (
                    newest.mode is Mode.REFLEX or (arm in self._refused and newest.mode is Mode.IDLE)
                ):
                    self._refused.discard(arm)
                    link.recover()
                    session.hear(link.read(), time.monotonic())
        except (*ERRORS, PlantError) as error:
            self._fail(arm, error)
            return
        if not all(
            its.state.newest is not None and its.state.newest.mode is Mode.IDLE for its in self._sessions.values()
        ):
            return
        try:
            for arm, link in self._links.items():
                measured = link.start(self._mode)
                came = time.monotonic()
                session = self._sessions[arm]
                session.hear(measured, came)
                session.begin(np.array(measured.held), came)
                self._write(
                    arm, np.array(measured.held) if self._mode is CommandMode.POSITION else np.zeros(JOINTS), True
                )
                values = session.answer(came, 0.0)
                link.write(values.tolist())
                self._write(arm, values)
        except ERRORS as error:
            self._refused.add(arm)
            self._lost(arm, error)
        for arm in self._sessions:
            self._tell(arm)

    def _fail(self, arm: str, error: Exception) -> None:
        session = self._sessions[arm]
        session.state.problem = reason_of(error)
        if type(error).__name__ == "NetworkException":
            self._lose(arm)
        self._tell(arm)
