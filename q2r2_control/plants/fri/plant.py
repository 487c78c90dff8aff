"""One or two arms that KUKA's cabinets control. A process answers the cabinets; the loop sends it the arms' motion."""

from __future__ import annotations

import socket
import time
from collections import deque
from collections.abc import Callable, Iterable

from q2r2_control.config.cell import Config
from q2r2_control.config.fri import GripperIoConfig, ModbusGripperConfig
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.events import Reason
from q2r2_control.plants.base import check_command
from q2r2_control.plants.fri.answering import CabinetAnswers, Line, open_socket
from q2r2_control.plants.fri.cell import FriCell
from q2r2_control.plants.fri.session import ArmSession
from q2r2_control.plants.fri.session_state import SessionState
from q2r2_control.plants.fri.waiting import CabinetWait
from q2r2_control.plants.fri.wire import JOINTS, CommandKind
from q2r2_control.plants.modbus_gripper import ModbusGripper
from q2r2_control.robot.commissioned import has_real_cabinets
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ArmTiming, Array, Command, CommandMode, RobotState
from q2r2_control.wording import sentence

# Number of answers whose times are kept. It is bounded, because the garbage collector visits all these times in a run.
_KEPT = 100_000
_KINDS = {CommandMode.POSITION: CommandKind.POSITION, CommandMode.TORQUE: CommandKind.TORQUE}


class FriPlant:
    """Arms behind KUKA's cabinets. They start where they stand, also after a cabinet has ended a session."""

    modes: tuple[CommandMode, ...] = (CommandMode.POSITION, CommandMode.TORQUE)
    realtime_only = True
    # Longest times that a reset waits for the first message of each cabinet, and for all sessions to begin [s]. If some
    # sessions do not begin, the run begins nevertheless.
    longest_wait = longest_session_wait = 5.0

    def __init__(self, robot: Robot, config: Config) -> None:
        """Make the plant.

        Raises:
            ConfigError: If an arm lacks a cabinet or does not have seven joints, if the package of a gripper is
                missing, or if ``control.max_substep`` is shorter than two loop periods. With so short a value, a late
                tick would be split into steps, but a cabinet can follow only one parabola per tick.
        """
        for arm, its in robot.arms.items():
            if arm not in set(config.fri):
                raise ConfigError(f"fri.{arm}: missing; allowed: the cabinet of each arm, as {{port: 30200}}")
            if len(its.joints) != JOINTS:
                raise ConfigError(f"fri.{arm}: the arm has {len(its.joints)} joints; allowed: {JOINTS}")
        self._robot, self._cabinets = robot, {str(arm): cabinet for arm, cabinet in config.fri.items()}
        self._period, self._longest = 1.0 / config.nominal_rate_hz, config.control.max_substep
        if self._longest < 2.0 * self._period:
            allowed = "allowed with cabinets: two ticks of loop_rate_hz or more, such as 0.01"
            raise ConfigError(f"control.max_substep = {self._longest:g}: {allowed}")
        self._torque_rate_limit = config.impedance.torque_rate_limit
        self.begin(CommandMode.POSITION)
        self.grippers = self._modbus_grippers()
        self._answering: CabinetAnswers | None = None
        # For the newest messages, the arrival by the monotonic clock, and the time until the answer was sent [s].
        self.answers: deque[tuple[float, float]] = deque(maxlen=_KEPT)

    @classmethod
    def from_config(cls, robot: Robot, config: Config) -> FriPlant:
        return cls(robot, config)

    @classmethod
    def drives_real_arms(cls, config: Config) -> bool:
        """See :class:`RealPlant`."""
        return has_real_cabinets(config)

    @property
    def addresses(self) -> list[str]:
        """The addresses of the cabinets."""
        return [cabinet.address for cabinet in self._cabinets.values()]

    def begin(self, mode: CommandMode, stopped: Callable[[], bool] = lambda: False) -> None:
        """See :meth:`SessionPlant.begin`."""
        self._mode, self._stopped = mode, stopped

    def reset(self, q: Array | None = None) -> None:
        """Start the process that answers the cabinets, and wait for their sessions.

        Raises:
            PlantError: If a cabinet sends no message, or if ``q`` is given, because real arms start where they stand.
        """
        if q is not None:
            raise PlantError("reset q: a real arm starts where it stands")
        self.close()
        lines = self._lines()
        grippers = {arm: its.gripper for arm, its in self._cabinets.items() if isinstance(its.gripper, GripperIoConfig)}
        self.cell = FriCell(self._robot, [line.session.state for line in lines], self._period, self._longest, grippers)
        try:
            self._answering = CabinetAnswers(lines)
        finally:
            for line in lines:
                socket.close(line.file)  # The socket is closed here, because the process has a copy of it.
        self.grippers = self._modbus_grippers()
        for gripper in self.grippers.values():
            gripper.start()
        try:
            self._wait()
        except PlantError:
            self.close()
            raise

    def _wait(self) -> None:
        """Wait for the cabinets; raises :class:`PlantError` if a cabinet sends no message."""
        waiting = CabinetWait(self._stopped)

        def looked(ready: Callable[[], bool]) -> bool:
            self.due(time.monotonic())
            return ready()

        def states() -> Iterable[SessionState]:
            return self.cell.states.values()

        if not waiting.until(lambda: looked(lambda: self.cell.is_heard), states, self.longest_wait):
            problem = self.cell.fault()
            why = "no cabinet was heard" if problem is None else sentence(problem)
            ended = "the wait was stopped" if waiting.was_stopped else "waited for that"
            raise PlantError(f"{why}; {ended} after {waiting.passed:.1f} s")
        waiting.until(lambda: looked(lambda: self.cell.fault() is None), states, self.longest_session_wait)

    def is_released(self) -> bool:
        """Return whether no process on this computer answers the cabinets any more, so that nothing moves the arms."""
        try:
            for line in self._lines():
                socket.close(line.file)
        except PlantError:
            return False
        return True

    def _lines(self) -> list[Line]:
        lines: list[Line] = []
        for arm, its in self._cabinets.items():
            source = f"cabinet {its.address} on port {its.port}"
            joints = self._robot.arms[arm].joints
            limits = self._robot.torque_limit[joints], self._robot.velocity_limit[joints], self._torque_rate_limit
            session = ArmSession(arm, source, its.version, _KINDS[self._mode], *limits)
            try:
                lines.append(Line(session, its.address, open_socket(its.address, its.port).detach()))
            except OSError as error:
                for line in lines:
                    socket.close(line.file)
                raise PlantError(f"fri.{arm}.port = {its.port}: cannot be bound: {error.strerror}") from error
        return lines

    def states(self) -> dict[str, SessionState]:
        """Return the state of each arm's session after the newest message of its cabinet."""
        if self._answering is not None:
            states, answers = self._answering.receive()
            self.answers.extend(answers)
            for state in states:
                self.cell.update(state)
        return self.cell.states

    def due(self, now: float) -> tuple[float, float]:
        """See :meth:`FriCell.due`; raises :class:`PlantError` if the process that answers the cabinets has ended."""
        self.states()
        return self.cell.due(now)

    def withdraws(self) -> bool:
        """See :meth:`FriCell.withdraws`."""
        return self.cell.withdraws()

    def delay(self) -> float:
        """See :meth:`FriCell.delay`."""
        return self.cell.delay()

    def timings(self) -> dict[str, ArmTiming]:
        """See :meth:`FriCell.timings`."""
        return self.cell.timings()

    def lead(self) -> float:
        """See :meth:`FriCell.lead`."""
        return self.cell.lead()

    def fault(self) -> Reason | None:
        """See :meth:`FriCell.fault`."""
        return self.cell.fault()

    def sessions(self) -> dict[str, str]:
        return {arm: state.words for arm, state in self.cell.states.items()}

    def apply(self, command: Command) -> None:
        check_command(command, self._robot, self.modes)
        assert self._answering is not None
        self.cell.sent(self._answering.send(self.cell.apply(command)))
        for arm, gripper in self.grippers.items():
            if arm in command.grippers:
                gripper.command(float(command.grippers[arm]))

    def advance(self, dt: float) -> None:
        """Do nothing, because the time of real arms passes by itself."""

    def state(self) -> RobotState:
        return self.cell.state()

    def gripper_openings(self) -> dict[str, float]:
        """See :meth:`Plant.gripper_openings`. Before a run, each gripper that the run will measure counts as open."""
        if self._answering is None:
            its = {arm: cabinet.gripper for arm, cabinet in self._cabinets.items()}
            return {arm: 1.0 for arm, one in its.items() if one is not None and getattr(one, "input", True) is not None}
        by_modbus = {arm: gripper.opening for arm, gripper in self.grippers.items()}
        known = {arm: opening for arm, opening in by_modbus.items() if opening is not None}
        return {**self.cell.openings(), **known}

    def close(self) -> None:
        if self._answering is not None:
            self._answering.close()
            self._answering = None
            for gripper in self.grippers.values():
                gripper.close()

    def _modbus_grippers(self) -> dict[str, ModbusGripper]:
        """Make new grippers, which know nothing of an earlier run."""
        configs = {arm: cabinet.gripper for arm, cabinet in self._cabinets.items()}
        return {arm: ModbusGripper(arm, its) for arm, its in configs.items() if isinstance(its, ModbusGripperConfig)}
