"""Two arms, or one, behind KUKA's cabinets: a thread answers them, the loop says where the arms are to go."""

from __future__ import annotations

import select
import socket
import struct
import sys
import time
from collections import deque
from threading import Thread

from q2r2_control.config.cell import Config
from q2r2_control.config.fri import GripperIoConfig, ModbusGripperConfig
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.events import Reason
from q2r2_control.plants.base import check_command
from q2r2_control.plants.fri.cell import FriCell
from q2r2_control.plants.fri.session import ArmSession
from q2r2_control.plants.fri.wire import JOINTS, LONGEST, CommandKind
from q2r2_control.plants.modbus_gripper import ModbusGripper
from q2r2_control.process.scheduling import schedule_thread_first, thread_priority
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, RobotState
from q2r2_control.wording import sentence

_WAIT = 5.0  # for each cabinet's first message, and for its session, without which a run begins all the same [s]
_KEPT = 100_000  # answer times
_POLL = 0.05  # of looking whether the plant was closed [s]
_SWITCH = 5e-5  # Python's threads take turns as often as this, or an answer would wait for the loop [s]
# Linux stamps datagrams as they arrive (SO_TIMESTAMPNS) by its real-time clock; longer waits are jumps of that [s].
_TIMESTAMP, _TIMESPEC, _EXTRA, _LONGEST_WAIT = 35, struct.Struct("@qq"), 64, 0.1
_KINDS = {CommandMode.POSITION: CommandKind.POSITION, CommandMode.TORQUE: CommandKind.TORQUE}


class FriPlant:
    """The arms start where they stand, and again after each session that a cabinet ended."""

    modes: tuple[CommandMode, ...] = (CommandMode.POSITION, CommandMode.TORQUE)
    realtime_only = True

    def __init__(self, robot: Robot, config: Config) -> None:
        """Raises :class:`ConfigError` unless every arm has a cabinet and seven joints, and a gripper its package."""
        for arm, its in robot.arms.items():
            if arm not in set(config.fri):
                raise ConfigError(f"fri.{arm}: missing; allowed: the cabinet of each arm, as {{port: 30200}}")
            if len(its.joints) != JOINTS:
                raise ConfigError(f"fri.{arm}: the arm has {len(its.joints)} joints; allowed: {JOINTS}")
        self._robot, self._cabinets = robot, {str(arm): cabinet for arm, cabinet in config.fri.items()}
        self._period = 1.0 / config.loop_rate_hz
        self._mode = CommandMode.POSITION
        self._sockets: dict[str, socket.socket] = {}
        self.grippers = self._modbus_grippers()
        self._thread: Thread | None = None
        # Of the newest answers, from a message's arrival until its answer was sent [s].
        self.answer_times: deque[float] = deque(maxlen=_KEPT)

    @classmethod
    def from_config(cls, robot: Robot, config: Config) -> FriPlant:
        return cls(robot, config)

    @property
    def addresses(self) -> list[str]:
        """Of the cabinets."""
        return [cabinet.address for cabinet in self._cabinets.values()]

    def begin(self, mode: CommandMode) -> None:
        """Commands of this ``mode`` are to come after the next :meth:`reset`."""
        self._mode = mode

    def reset(self, q: Array | None = None) -> None:
        """Hear the cabinets. Raises :class:`PlantError` where one says nothing, and for ``q``: arms are not placed."""
        if q is not None:
            raise PlantError("reset q: a real arm starts where it stands")
        self.close()
        sessions: dict[str, ArmSession] = {}
        for arm, cabinet in self._cabinets.items():
            source = f"cabinet {cabinet.address} on port {cabinet.port}"
            sessions[arm] = ArmSession(arm, source, cabinet.version)
            sessions[arm].wanted = _KINDS[self._mode]
        grippers = {arm: its.gripper for arm, its in self._cabinets.items() if isinstance(its.gripper, GripperIoConfig)}
        self.cell = FriCell(self._robot, sessions, self._period, grippers)
        try:
            for arm, cabinet in self._cabinets.items():
                self._sockets[arm] = _opened(cabinet.address, cabinet.port)
        except OSError as error:
            self.close()
            raise PlantError(f"fri.{arm}.port = {cabinet.port}: cannot be bound: {error.strerror}") from error
        self._before, self._running = sys.getswitchinterval(), True
        sys.setswitchinterval(_SWITCH)
        # An answer goes before the loop, where that has a priority.
        priority = thread_priority()
        self._thread = Thread(target=self._answer, args=(priority and priority + 1,), name="fri", daemon=True)
        self._thread.start()
        self.grippers = self._modbus_grippers()
        for gripper in self.grippers.values():
            gripper.start()
        deadline = time.monotonic() + _WAIT
        while not self.cell.is_heard and time.monotonic() < deadline:
            time.sleep(0.01)
        if not self.cell.is_heard:
            self.cell.due(time.monotonic())
            problem = self.cell.fault()
            self.close()
            raise PlantError("no cabinet was heard" if problem is None else sentence(problem))
        self.cell.due(time.monotonic())
        while self.cell.fault() is not None and time.monotonic() < deadline:
            time.sleep(0.01)
            self.cell.due(time.monotonic())

    def due(self, now: float) -> tuple[float, float]:
        """See :meth:`FriCell.due`."""
        return self.cell.due(now)

    def withdraws(self) -> bool:
        """See :meth:`FriCell.withdraws`."""
        return self.cell.withdraws()

    def delay(self) -> float:
        """See :meth:`FriCell.delay`."""
        return self.cell.delay()

    def fault(self) -> Reason | None:
        """See :meth:`FriCell.fault`."""
        return self.cell.fault()

    def sessions(self) -> dict[str, str]:
        return {arm: session.words for arm, session in self.cell.sessions.items()}

    def apply(self, command: Command) -> None:
        check_command(command, self._robot, self.modes)
        self.cell.apply(command)
        for arm, gripper in self.grippers.items():
            if arm in command.grippers:
                gripper.command(float(command.grippers[arm]))

    def advance(self, dt: float) -> None:
        """Time passes by itself."""

    def state(self) -> RobotState:
        return self.cell.state()

    def gripper_openings(self) -> dict[str, float]:
        by_modbus = {arm: gripper.opening for arm, gripper in self.grippers.items()}
        known = {arm: opening for arm, opening in by_modbus.items() if opening is not None}
        return {**self.cell.openings(), **known}

    def close(self) -> None:
        if self._thread is not None:
            self._running = False
            self._thread.join()
            self._thread = None
            sys.setswitchinterval(self._before)
            for gripper in self.grippers.values():
                gripper.close()
        for opened in self._sockets.values():
            opened.close()
        self._sockets.clear()

    def _modbus_grippers(self) -> dict[str, ModbusGripper]:
        """New ones, which know nothing of an earlier run."""
        configs = {arm: cabinet.gripper for arm, cabinet in self._cabinets.items()}
        return {arm: ModbusGripper(arm, its) for arm, its in configs.items() if isinstance(its, ModbusGripperConfig)}

    def _answer(self, priority: int) -> None:
        if priority:
            schedule_thread_first(priority)
        arms = {opened.fileno(): (arm, opened) for arm, opened in self._sockets.items()}
        poll = select.poll()
        for number in arms:
            poll.register(number, select.POLLIN)
        while self._running:
            for number, _ in poll.poll(1e3 * _POLL):
                arm, opened = arms[number]
                try:
                    datagram, extra, _, source = opened.recvmsg(LONGEST + 1, _EXTRA)
                    if source[0] != self._cabinets[arm].address:
                        continue
                    waited = _waited(extra)
                    came = time.monotonic() - waited
                    answer = self.cell.answer(arm, datagram, came)
                    if answer is not None:
                        opened.sendto(answer, source)
                        self.answer_times.append(time.monotonic() - came)
                except OSError:  # a cabinet that is gone refuses; its silence is noticed
                    continue


def _opened(address: str, port: int) -> socket.socket:
    """A socket for one cabinet: loopback where it is on this computer, else all of its networks."""
    opened = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.bind((address if address in ("127.0.0.1", "::1") else "", port))
    except OSError:
        opened.close()
        raise
    opened.setblocking(False)
    opened.setsockopt(socket.SOL_SOCKET, _TIMESTAMP, 1)
    return opened


def _waited(extra: list[tuple[int, int, bytes]]) -> float:
    """How long ago the kernel received a datagram [s]; 0 where it does not say."""
    for _, kind, data in extra:
        if kind == _TIMESTAMP:
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return min(max(time.time() - seconds - 1e-9 * nanoseconds, 0.0), _LONGEST_WAIT)
    return 0.0
