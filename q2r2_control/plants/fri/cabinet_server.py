"""Simulated cabinets that use real sockets in real time, and move the arms of a simulated cell, for rehearsals."""

from __future__ import annotations

import heapq
import math
import select
import socket
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.config.fri import GripperIoConfig
from q2r2_control.errors import ConfigError
from q2r2_control.plants.fri.answers import CATCH_UP, CATCH_UP_RAMP
from q2r2_control.plants.fri.cabinet import Cabinet, CabinetSettings
from q2r2_control.plants.fri.wire import (
    JOINTS,
    LONGEST,
    CommandKind,
    IoValue,
    Joints,
    Session,
    joints_of,
    write_monitoring,
)
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode

# After a stall of this process, a client that commands still gets the messages that are late by up to this time [s].
# Earlier messages are left out, as if the cabinets had been silent.
_LONGEST_STALL = 1.0
_LONGEST_CATCH_UP = 0.05  # Longest time that the simulation catches up in one step [s]. Any further time is dropped.
_LOOK_AGAIN = 2e-4  # Time between two checks for an answer, while the next message waits for it [s].
_ROUNDING = 1e-6  # Relative tolerance of durations.
_SAG = 1e-3  # A cabinet allows positions this far beyond the robot's limits, because the simulated arm sags [rad].
_DAMPING_RATIO = 0.7  # Damping ratio of the application's joint impedance. It is the cabinet's default.
# Without a torque overlay, a cabinet holds an arm by a critically damped spring. The damping alone would slow the arm
# down with this time constant [s].
_HOLDING = 0.02


@dataclass(frozen=True, slots=True)
class Network:
    """Faults of the network between cabinet and client."""

    loss: float = 0.0  # Share of lost datagrams in each direction.
    duplicate: float = 0.0  # Share of messages that come twice.
    jitter: float = 0.0  # Largest random delay of a datagram [s]. Later datagrams can overtake it.
    cut: float = 0.0  # Share of datagrams that lose their end, in each direction.


_PERFECT = Network()


class SimulatedArm:
    """One arm of a :class:`SimulatedArms`."""

    def __init__(self, cell: SimulatedArms, arm: str) -> None:
        self._cell, self._name, self._joints = cell, arm, cell.robot.arms[arm].joints
        start = joints_of(cell.robot.home[self._joints])
        self._from, self._to, self._began, self._lasts = start, start, 0.0, 1.0
        self.overlay: Joints | None = None

    @property
    def q(self) -> Joints:
        return joints_of(self._cell.state.q[self._joints])

    @property
    def tau(self) -> Joints:
        return joints_of(self._cell.state.tau[self._joints])

    @property
    def external_tau(self) -> Joints:
        external = self._cell.state.tau_external
        return (0.0,) * JOINTS if external is None else joints_of(external[self._joints])

    def advance(self, dt: float, q: Joints, tau: Joints | None) -> None:
        """Begin a motion to ``q`` that takes ``dt`` [s]. Only :meth:`SimulatedArms.advance` lets time pass."""
        self._from, self._to, self._began, self._lasts = self._to, q, self._cell.now, dt
        self.overlay = tau

    def tool_way(self, start: Joints, end: Joints) -> float:
        tools = []
        for joints in (start, end):
            q = self._cell.robot.home.copy()
            q[self._joints] = joints
            tools.append(self._cell.robot.tool_pose(q, self._name).translation)
        return float(np.linalg.norm(tools[1] - tools[0]))

    def wanted(self, t: float) -> tuple[Array, Array]:
        """Return the wanted position (n,) [rad] and velocity (n,) [rad/s] of the drives at ``t`` [s]."""
        share, change = (t - self._began) / self._lasts, np.subtract(self._to, self._from)
        if share > 1.0 + _ROUNDING:  # If the next message is in time, ``share`` is 1 then, and the drives still move.
            return np.array(self._to), np.zeros(JOINTS)
        return np.add(self._from, max(share, 0.0) * change), change / self._lasts


class SimulatedArms:
    """All arms of a cell in one simulation."""

    def __init__(self, robot: Robot, config: Config, stiffness: float = 0.0) -> None:
        """Make the arms. Torque commands are added to a joint impedance with this ``stiffness`` [Nm/rad]."""
        self.robot, self.plant, self._stiffness = robot, MujocoPlant(robot, config), stiffness
        self.now, self.openings = 0.0, dict.fromkeys(self.plant.gripper_openings(), 1.0)
        self._simulated, self._step = 0.0, (1.0 - _ROUNDING) * config.mujoco.timestep
        self.state = self.plant.state()
        self.arms = {arm: SimulatedArm(self, arm) for arm in robot.arms}
        self._data = robot.model.createData()

    def advance(self, now: float) -> None:
        """Let the time until ``now`` [s] pass. The physics waits until one of its steps is due."""
        self.now = now
        passed = now - self._simulated
        if passed >= self._step:
            self._simulated = now
            self.plant.apply(self._command())
            self.plant.advance(min(passed, _LONGEST_CATCH_UP))
            self.state = self.plant.state()

    def work_gripper(self, arm: str, gripper: GripperIoConfig, cabinet: Cabinet) -> None:
        """Let a cabinet's output command the arm's gripper, and its input show the opening."""
        self.openings[arm] = min(max(float(cabinet.outputs[gripper.output]), 0.0), 1.0)
        if gripper.input is not None:
            cabinet.inputs[gripper.input] = self.plant.gripper_openings()[arm]

    def _command(self) -> Command:
        q, v = np.zeros((2, self.robot.model.nv))
        for name, arm in self.arms.items():
            joints = self.robot.arms[name].joints
            q[joints], v[joints] = arm.wanted(self.now)
        if all(arm.overlay is None for arm in self.arms.values()):
            return Command(CommandMode.POSITION, q, v, 0.0 * q, self.openings)
        state = self.plant.state()
        tau = pin.computeGeneralizedGravity(self.robot.model, self._data, state.q).copy()
        inertia = pin.crba(self.robot.model, self._data, state.q).diagonal()
        back = inertia / _HOLDING * ((q - state.q) / (4.0 * _HOLDING) - state.v)
        spring = self._stiffness * (q - state.q) - 2.0 * _DAMPING_RATIO * np.sqrt(self._stiffness * inertia) * state.v
        for name, arm in self.arms.items():
            joints = self.robot.arms[name].joints
            tau[joints] += back[joints] if arm.overlay is None else spring[joints] + arm.overlay
        return Command(CommandMode.TORQUE, q, v, tau, self.openings)


def outputs_of(gripper: GripperIoConfig | None) -> dict[str, IoValue]:
    """Return the outputs that a cabinet's application registers for ``gripper``, with values for an open gripper."""
    return {} if gripper is None else {gripper.output: True if gripper.digital else 1.0}


def settings_of(
    robot: Robot, arm: str, kind: CommandKind, version: int, period: float, multiplier: int = 1
) -> CabinetSettings:
    """Return the settings of a cabinet that guards the robot's limits.

    Its limits of acceleration are larger than the robot's, because answers that catch up accelerate the arm more.
    """
    joints = robot.arms[arm].joints
    acceleration = (1.0 + CATCH_UP) ** 2 * robot.acceleration_limit + CATCH_UP_RAMP * robot.velocity_limit
    return CabinetSettings(
        lower=joints_of(robot.position_lower[joints] - _SAG),
        upper=joints_of(robot.position_upper[joints] + _SAG),
        velocity=joints_of(robot.velocity_limit[joints]),
        acceleration=joints_of(acceleration[joints]),
        torque=joints_of(robot.torque_limit[joints]),
        version=version,
        period=period,
        multiplier=multiplier,
        command=kind,
    )


class CabinetServer:
    """Sends each cabinet's messages to its client's address, and receives the answers."""

    def __init__(
        self,
        cell: SimulatedArms,
        cabinets: Mapping[str, CabinetSettings],
        origins: Mapping[str, tuple[str, int]],
        clients: Mapping[str, tuple[str, int]],
        grippers: Mapping[str, GripperIoConfig],
        network: Network,
        seed: int = 0,
    ) -> None:
        """Make the server, and bind the addresses of the cabinets.

        Args:
            cell: The simulated arms.
            cabinets: The settings of each arm's cabinet.
            origins: Address and port from which each arm's cabinet sends. Port 0 stands for any free port.
            clients: Address and port of each cabinet's client.
            grippers: The grippers at the cabinets, by arm.
            network: The faults of the network.
            seed: The seed of the random faults.

        Raises:
            ConfigError: If an origin cannot be bound, for example because another program uses it.
        """
        self.cell, self._clients, self._grippers, self._network = cell, dict(clients), dict(grippers), network
        self.cabinets = {
            arm: Cabinet(settings, cell.arms[arm], outputs_of(self._grippers.get(arm)))
            for arm, settings in cabinets.items()
        }
        self._random = np.random.default_rng(seed)
        self._sockets = {arm: _opened(arm, *origins[arm]) for arm in self.cabinets}
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._serial = 0
        self._sent_at: dict[str, float] = {}  # Time of the newest message of each arm [s].

    def run(self, until: Callable[[float], bool], tick: Callable[[float], None] = lambda t: None) -> None:
        """Run until ``until`` returns True. The argument of ``until`` is the time since the start [s].

        ``tick`` is called after each message of a cabinet, with the time at which this message was due [s].
        """
        self._began, now, arms = time.monotonic(), 0.0, {opened: arm for arm, opened in self._sockets.items()}
        for index, (arm, cabinet) in enumerate(self.cabinets.items()):
            self._at(index * 0.37 * cabinet.settings.period, lambda arm=arm: self._send(arm, 0.0, tick))  # type: ignore[misc]
        try:
            while not until(now):
                rest = max(self._queue[0][0] - (time.monotonic() - self._began), 0.0)
                ready, _, _ = select.select(list(arms), (), (), rest)
                now = time.monotonic() - self._began
                for opened in ready:
                    self._hear(arms[opened], now)
                # One message is sent at a time, so that an answer that has come is read before the next message.
                if self._queue[0][0] <= now:
                    heapq.heappop(self._queue)[2]()
        finally:
            for opened in self._sockets.values():
                opened.close()

    def _at(self, t: float, act: Callable[[], None]) -> None:
        self._serial += 1
        heapq.heappush(self._queue, (t, self._serial, act))

    def _after(self, late: float, t: float, act: Callable[[], None]) -> None:
        """Call ``act`` at once if ``late`` is 0, otherwise ``late`` [s] after ``t`` [s].

        An answer without delay is taken at once, because in the queue it would wait behind a late message.
        """
        if late > 0.0:
            self._at(t + late, act)
        else:
            act()

    def _send(self, arm: str, due: float, tick: Callable[[float], None]) -> None:
        cabinet, opened, client = self.cabinets[arm], self._sockets[arm], self._clients[arm]
        # A client that commands always has a full period for its answer, even if this process was late.
        commands = cabinet.session >= Session.COMMANDING_WAIT
        enough, now = self._sent_at.get(arm, -math.inf) + cabinet.settings.period, time.monotonic() - self._began
        if commands and not cabinet.is_answered and now < enough:
            self._at(min(enough, now + _LOOK_AGAIN), lambda: self._send(arm, due, tick))
            return
        self.cell.advance(due)
        if (gripper := self._grippers.get(arm)) is not None:
            self.cell.work_gripper(arm, gripper, cabinet)
        datagram = self._cut(write_monitoring(cabinet.send(due)))
        for late in self._delays(self._network.duplicate):
            self._after(late, due, lambda: _sent(opened, datagram, client))
        self._sent_at[arm] = now = time.monotonic() - self._began
        # Messages are due on a fixed grid of time. If this process was late, the next messages follow each other at
        # shorter intervals, until they are on the grid again.
        following = max(due + cabinet.settings.period, now - (_LONGEST_STALL if commands else 0.0))
        self._at(following, lambda: self._send(arm, following, tick))
        tick(due)

    def _hear(self, arm: str, now: float) -> None:
        while True:
            try:
                datagram, source = self._sockets[arm].recvfrom(LONGEST + 1)
            except OSError:  # Reading fails if there are no more datagrams, or if no client listens yet.
                return
            if source[:2] == self._clients[arm]:
                for late in self._delays(0.0):
                    self._after(late, now, partial(self.cabinets[arm].receive, self._cut(datagram)))

    def _cut(self, datagram: bytes) -> bytes:
        is_cut = self._random.random() < self._network.cut
        return datagram[: self._random.integers(len(datagram))] if is_cut else datagram

    def _delays(self, duplicate: float) -> Iterable[float]:
        """Return the delay of each copy of a datagram [s]. The result is empty if the datagram is lost.

        ``duplicate`` is the probability that there are two copies.
        """
        if self._network == _PERFECT:
            return [0.0]
        copies = 0 if self._random.random() < self._network.loss else 1 + (self._random.random() < duplicate)
        return [float(self._random.uniform(0.0, self._network.jitter)) for _ in range(copies)]


def _sent(opened: socket.socket, datagram: bytes, client: tuple[str, int]) -> None:
    try:
        opened.sendto(datagram, client)
    except OSError:  # Sending fails if no client listens yet.
        return


def _opened(arm: str, address: str, port: int) -> socket.socket:
    opened = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.bind((address, port))
    except OSError as error:
        opened.close()
        allowed = "allowed: a loopback address as 127.0.0.2, and a port that is free"
        raise ConfigError(
            f"the {arm} cabinet cannot send from {address}, port {port}: {error.strerror}; {allowed}"
        ) from error
    opened.setblocking(False)
    return opened
