"""Simulated KUKA cabinets in the virtual time of a loop: drift, jitter, loss, and a pendant."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from copy import copy

import numpy as np

from q2r2_control.config.fri import GripperIoConfig
from q2r2_control.events import Reason
from q2r2_control.plants.base import check_command
from q2r2_control.plants.fri.cabinet import Cabinet, CabinetSettings, StillArm
from q2r2_control.plants.fri.cabinet_server import SimulatedArms, outputs_of
from q2r2_control.plants.fri.cell import FriCell
from q2r2_control.plants.fri.session import ArmSession, answer, follow
from q2r2_control.plants.fri.wire import CommandKind, Session, write_monitoring
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ArmTiming, Array, Command, CommandMode, RobotState

_BEGIN = -0.1  # Time at which the cabinets begin [s].
_KINDS = {CommandMode.POSITION: CommandKind.POSITION, CommandMode.TORQUE: CommandKind.TORQUE}


class VirtualCabinets:
    """A plant in which every message and every answer takes time, and some are lost."""

    modes: tuple[CommandMode, ...] = (CommandMode.POSITION, CommandMode.TORQUE)
    realtime_only = False

    def __init__(
        self,
        robot: Robot,
        settings: dict[str, CabinetSettings],
        start: Array,
        period: float,
        longest: float,
        *,
        drift: float = 0.0,
        jitter: float = 0.0,
        loss: float = 0.0,
        seed: int = 0,
        arms: SimulatedArms | None = None,
        grippers: dict[str, GripperIoConfig] | None = None,
    ) -> None:
        """Make cabinets for a loop with this ``period`` and ``longest`` step [s].

        ``drift`` is the relative difference of the rates of the cabinets' clocks. Messages are up to ``jitter`` [s]
        late, and ``loss`` is the share of lost messages. Without ``arms``, each arm is always at its commanded
        position, and torques do not move it.
        """
        self._robot, self._period, self._longest, self._random = robot, period, longest, np.random.default_rng(seed)
        self._jitter, self._loss = jitter, loss
        self._simulation, self._grippers = arms, grippers or {}
        self.cabinets = {
            arm: Cabinet(
                its,
                arms.arms[arm] if arms else StillArm(tuple(start[robot.arms[arm].joints])),
                outputs_of(self._grippers.get(arm)),
            )
            for arm, its in settings.items()
        }
        rates = np.linspace(1.0 - 0.5 * drift, 1.0 + 0.5 * drift, len(settings))
        self._rates = dict(zip(settings, rates, strict=True))
        self.on_message: Callable[[str, float], None] = lambda arm, t: None
        self.asleep_until = -1.0  # This computer does nothing before this time [s].
        self.stands_until = dict.fromkeys(self.cabinets, -1.0)  # A cabinet does nothing before this time [s].
        self.unplugged: set[str] = set()  # Cabinets whose cable is unplugged, so that nothing passes.
        self.thinking = 0.0  # Time between the beginning of a tick and its command [s].
        self._mode = CommandMode.POSITION

    def begin(self, mode: CommandMode, stopped: Callable[[], bool]) -> None:
        self._mode = mode

    def reset(self, q: Array | None = None) -> None:
        self.lines = {}
        for arm in self.cabinets:
            joints = self._robot.arms[arm].joints
            limits = self._robot.torque_limit[joints], self._robot.velocity_limit[joints], 5000.0
            self.lines[arm] = ArmSession(arm, "cabinet", None, _KINDS[self._mode], *limits)
        states = [copy(session.state) for session in self.lines.values()]
        self.cell = FriCell(self._robot, states, self._period, self._longest, self._grippers)
        self.now, self._serial = _BEGIN, 0  # The loop begins later, at the time 0.
        self._events: list[tuple[float, int, Callable[..., None], tuple[object, ...]]] = []
        # For each arm, the positions at each message of a session: the commanded positions that the cabinet follows or,
        # in torque mode, the measured positions. After a session has ended, they are NaN.
        self.heard: dict[str, list[Array]] = {arm: [] for arm in self.cabinets}
        for arm in self.cabinets:
            self._at(self.now, self._send, arm)
        self.due(0.0)

    def due(self, now: float) -> tuple[float, float]:
        self._pass(now)
        return self.cell.due(now)

    def timings(self) -> dict[str, ArmTiming]:
        return self.cell.timings()

    def lead(self) -> float:
        return self.cell.lead()

    def fault(self) -> Reason | None:
        return self.cell.fault()

    def withdraws(self) -> bool:
        return self.cell.withdraws()

    def delay(self) -> float:
        return self.cell.delay()

    def sessions(self) -> dict[str, str]:
        return {arm: state.words for arm, state in self.cell.states.items()}

    def apply(self, command: Command) -> None:
        check_command(command, self._robot, self.modes)
        self._pass(self.now + self.thinking)
        self.cell.sent(follow(self.lines, self.cell.apply(command)))

    def advance(self, dt: float) -> None:
        """Let time pass until the next tick."""

    def state(self) -> RobotState:
        return self.cell.state()

    def gripper_openings(self) -> dict[str, float]:
        return self.cell.openings()

    def close(self) -> None:
        pass

    def _pass(self, now: float) -> None:
        """Process everything that happens until ``now`` [s]."""
        while self._events and self._events[0][0] <= now:
            self.now, _, act, arguments = heapq.heappop(self._events)
            act(*arguments)
        self.now = now

    def _at(self, t: float, act: Callable[..., None], *arguments: object) -> None:
        self._serial += 1
        heapq.heappush(self._events, (t, self._serial, act, arguments))

    def _late(self) -> float:
        return float(self._random.uniform(1e-4, 1e-4 + self._jitter))

    def _send(self, arm: str) -> None:
        cabinet = self.cabinets[arm]
        if self.now < self.stands_until[arm]:
            self._at(self.stands_until[arm], self._send, arm)
            return
        if self._simulation is not None:
            self._simulation.advance(self.now - _BEGIN)
            if arm in self._grippers:
                self._simulation.work_gripper(arm, self._grippers[arm], cabinet)
        self.on_message(arm, self.now)
        message = cabinet.send(self.now)
        if cabinet.session is Session.COMMANDING_ACTIVE:
            self.heard[arm].append(np.array(cabinet.commanded if self._mode is CommandMode.POSITION else message.q))
        elif self.heard[arm] and self.heard[arm][-1] is not None:
            self.heard[arm].append(np.full(7, np.nan))
        self._at(self.now + cabinet.settings.period * self._rates[arm], self._send, arm)
        if self._random.random() >= self._loss and arm not in self.unplugged:
            self._at(max(self.now + self._late(), self.asleep_until), self._receive, arm, write_monitoring(message))

    def _receive(self, arm: str, datagram: bytes) -> None:
        answer = self.answer(arm, datagram)
        if answer is not None and self._random.random() >= self._loss and arm not in self.unplugged:
            self._at(self.now + self._late(), self.cabinets[arm].receive, answer)

    def answer(self, arm: str, datagram: bytes) -> bytes | None:
        """Answer a datagram like the process that answers cabinets."""
        reply = answer(self.lines, arm, datagram, self.now)
        self.cell.update(copy(self.lines[arm].state))
        return reply
