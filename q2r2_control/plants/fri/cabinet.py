"""A simulated Sunrise cabinet: its session, its guards and its arm. It has no clock; callers pass the time to it.

It serves to test clients, and is not a model of KUKA's controller. The states and their conditions follow the public
client kits. Where the kits say nothing, such as how many answers a client may miss, the simulation is too strict
rather than too lenient.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from q2r2_control.errors import ConfigError, ProtocolError
from q2r2_control.plants.fri.wire import (
    JOINTS,
    CommandKind,
    Drives,
    FriCommand,
    IoValue,
    Joints,
    Monitoring,
    Operation,
    Quality,
    Safety,
    Session,
    read_command,
)

_WINDOW = 50  # Number of the newest answers by which the quality of the connection is judged.
# Smallest share of answers in time for each quality. KUKA publishes no such numbers. If GOOD needed 0.9, a loss of 1 %
# of the datagrams in each direction would end a session within minutes, because at some time 6 of 50 successive answers
# would be missed by chance.
_FAIR, _GOOD, _EXCELLENT = 0.5, 0.8, 0.98
_MISSES = 10  # Number of successive answers that may be late while the client commands.
_NEAR = 1e-3  # Largest distance of the first command from the cabinet's own position [rad].
_ROUNDING = 1e-6  # Relative tolerance of the limits.
_T1_SPEED = 0.25  # Largest speed of a tool in T1 [m/s].
_LONGEST_TORQUE_PERIOD = 0.005  # Longest time between two answers to an application that overlays torques [s].
_LARGEST_LOAD_ERROR = 2.0  # Largest external torque of a joint with which an overlay of torques may begin [Nm].


class Trip(StrEnum):
    """Reason why a cabinet ended the client's command."""

    LATE = "answers were late"
    MALFORMED = "an answer could not be read"
    VERSION = "an answer was of another FRI version"
    NO_POSITION = "an answer had no joint positions"
    NO_TORQUE = "an answer had no torques"
    POSITION = "a commanded position was beyond its limit"
    VELOCITY = "commanded positions were too far apart"
    ACCELERATION = "commanded velocities were too far apart"
    TORQUE = "a commanded torque was beyond its limit"
    T1 = "the tool was commanded faster than 250 mm/s, in T1"
    OUTPUT = "an answer wrote an output that the cabinet does not have"
    SAFETY = "safety stop"
    STOPPED = "stopped at the pendant"


class CabinetArm(Protocol):
    """The arm of a cabinet."""

    @property
    def q(self) -> Joints:
        """Measured positions [rad]."""

    @property
    def tau(self) -> Joints:
        """Measured torques [Nm]."""

    @property
    def external_tau(self) -> Joints:
        """Torques that contacts cause [Nm]."""

    def advance(self, dt: float, q: Joints, tau: Joints | None) -> None:
        """Let ``dt`` [s] pass. The drives move to ``q`` [rad], and add ``tau`` [Nm] to their impedance torques."""

    def tool_way(self, start: Joints, end: Joints) -> float:
        """Return the distance between the tool's positions in two postures [m]."""


@dataclass(slots=True)
class StillArm:
    """An arm that is always at its commanded position."""

    q: Joints
    tau: Joints = (0.0,) * JOINTS
    external_tau: Joints = (0.0,) * JOINTS

    def advance(self, dt: float, q: Joints, tau: Joints | None) -> None:
        self.q = q

    def tool_way(self, start: Joints, end: Joints) -> float:
        """Return the largest change of a joint, times a distance of 1 m from the joint's axis to the tool [m]."""
        return _apart(start, end)


@dataclass(frozen=True, slots=True)
class CabinetSettings:
    """One cabinet's FRI settings and guards. Joints are A1 .. A7."""

    lower: Joints  # Least allowed positions [rad].
    upper: Joints  # Greatest allowed positions [rad].
    velocity: Joints  # Velocity limits [rad/s].
    acceleration: Joints  # Acceleration limits [rad/s^2].
    torque: Joints  # Torque limits of the overlay [Nm].
    version: int = 2
    period: float = 0.005  # Time between two messages [s].
    multiplier: int = 1  # The cabinet expects one answer per this number of messages.
    command: CommandKind = CommandKind.POSITION

    def __post_init__(self) -> None:
        """Raise ConfigError if torques come less often than Sunrise allows."""
        if self.command is CommandKind.TORQUE and self.answer_period > _LONGEST_TORQUE_PERIOD * (1.0 + _ROUNDING):
            allowed = f"allowed with torques: {1e3 * _LONGEST_TORQUE_PERIOD:g} ms or less"
            raise ConfigError(f"a cabinet that is answered every {1e3 * self.answer_period:g} ms: {allowed}")

    @property
    def answer_period(self) -> float:
        """Time between two answers [s]."""
        return self.period * self.multiplier


class Cabinet:
    """A cabinet. In each period, call :meth:`send`, and then :meth:`receive` for each datagram that has come.

    All times are passed in [s].
    """

    def __init__(
        self, settings: CabinetSettings, arm: CabinetArm, outputs: Mapping[str, IoValue] | None = None
    ) -> None:
        """Make a cabinet.

        ``outputs`` are the outputs that the application registers for a client, with their first values.
        """
        self.settings, self.arm = settings, arm
        self.session, self.safety, self.operation = Session.MONITORING_WAIT, Safety.NORMAL, Operation.AUTOMATIC
        self.load_fits = True  # True if the load data fit the tool. Otherwise, no client may command.
        self.inputs: dict[str, IoValue] = {}  # Values of inputs, which the client reads.
        self.outputs = dict(outputs or {})  # Values of outputs, which the client may write in any state of the session.
        self.trips: list[Trip] = []  # Trips of all sessions, in order.
        self._sent = 0  # Number of messages so far.
        self._heard: int | None = None  # Counter of the client's newest message.
        self._answer: FriCommand | None = None  # Answer to the newest message that asked for one.
        self._in_time: deque[bool] = deque(maxlen=_WINDOW)  # Whether each of the newest answers came in time.
        self._misses = 0  # Number of answers that were missed one after the other until now.
        # Number of answers that were missed while a client commanded, until the client's last answer.
        self.missed = 0
        self._overlay = False  # True if the application asks for the client's command.
        self._held: Joints = arm.q  # Position that the cabinet's own motion holds.
        self.commanded: Joints = arm.q  # Position that the client commands, or the held position without a client.
        self._velocity: Joints = (0.0,) * JOINTS
        self._tau: Joints | None = None

    @property
    def quality(self) -> Quality:
        """The quality of the connection, judged by the share of the newest answers that came in time."""
        if len(self._in_time) < _WINDOW:
            return Quality.POOR
        share = sum(self._in_time) / len(self._in_time)
        return Quality((share >= _FAIR) + (share >= _GOOD) + (share >= _EXCELLENT))

    @property
    def is_answered(self) -> bool:
        """True if the newest message was answered, or asks for no answer."""
        return self._answer is not None or self._sent % self.settings.multiplier > 0

    def start_overlay(self) -> None:
        """Ask for the client's command, as the application does after a press on the pendant."""
        self._overlay = True

    def stop(self, trip: Trip = Trip.STOPPED) -> None:
        """End the command of the FRI client, so that the arm holds its position.

        The robot application has to start the overlay again before the client can command.
        """
        if self.session >= Session.COMMANDING_WAIT:
            self.trips.append(trip)
            self.session = Session.MONITORING_READY
        self._overlay, self._velocity, self._tau = False, (0.0,) * JOINTS, None
        self._held = self.commanded = self.arm.q

    def safety_stop(self, stop: Safety) -> None:
        """Begin a stop that the safety controller asks for; ``NORMAL`` ends it."""
        self.safety = stop
        if stop is not Safety.NORMAL:
            self.stop(Trip.SAFETY)

    def send(self, stamp: float) -> Monitoring:
        """Begin a period at ``stamp`` [s]: judge the last answer, move the arm, and return the cabinet's message."""
        if self._sent and self._sent % self.settings.multiplier == 0:
            self._judge()
        self.arm.advance(self.settings.period, self.commanded, self._tau)
        self._sent += 1
        commands = self.session >= Session.COMMANDING_WAIT
        self.message = Monitoring(
            version=self.settings.version,
            counter=self._sent,
            reflected=self._heard or 0,
            session=self.session,
            quality=self.quality,
            period=self.settings.period,
            multiplier=self.settings.multiplier,
            q=self.arm.q,
            stamp=stamp,
            tau=self.arm.tau,
            external_tau=self.arm.external_tau,
            commanded_q=self.commanded if self.settings.version == 1 else None,
            ipo_q=self._held if commands else None,
            command=self.settings.command if commands else CommandKind.NONE,
            safety=self.safety,
            operation=self.operation,
            drives=Drives.ACTIVE if commands else Drives.OFF,
            io=self.inputs | self.outputs,
            outputs=frozenset(self.outputs),
            commanded_tau=self._commanded_tau,
        )
        return self.message

    def receive(self, datagram: bytes) -> None:
        """Take an answer. An answer that repeats an older one, or answers an older message, counts as late."""
        try:
            version, command = read_command(datagram)
        except ProtocolError:
            self.stop(Trip.MALFORMED)
            return
        if version != self.settings.version:
            self.stop(Trip.VERSION)
        elif command.reflected == self._sent and (self._heard is None or command.counter != self._heard):
            self._heard, self._answer = command.counter, command
            if all(self.message.output(name, value) == value for name, value in command.io.items()):
                self.outputs |= command.io
            else:
                self.stop(Trip.OUTPUT)

    @property
    def _commanded_tau(self) -> Joints:
        """The torques that the motors are commanded to give: the measured torques plus the client's overlay [Nm]."""
        overlay = self._tau or (0.0,) * JOINTS
        return tuple(borne + added for borne, added in zip(self.arm.tau, overlay, strict=True))

    @property
    def _bears_the_load(self) -> bool:
        """True if the client's command may begin: the load data fit and, for torques, external torques are small."""
        torques = self.settings.command is CommandKind.TORQUE
        return self.load_fits and not (torques and max(map(abs, self.arm.external_tau)) > _LARGEST_LOAD_ERROR)

    def _judge(self) -> None:
        answer, self._answer = self._answer, None
        self._in_time.append(answer is not None)
        if answer is None:
            self._misses += 1
        else:
            self.missed += self._misses if self.session is Session.COMMANDING_ACTIVE else 0
            self._misses = 0
        if self.session is Session.COMMANDING_ACTIVE:
            if self._misses > _MISSES or self.quality < Quality.GOOD:
                self.stop(Trip.LATE)
            elif answer is not None:
                self._follow(answer)
        elif self.session is Session.COMMANDING_WAIT:
            if self.quality < Quality.GOOD:
                self.stop(Trip.LATE)
            elif not self._bears_the_load or answer is None or answer.q is None:
                return
            elif self.settings.command is CommandKind.TORQUE and answer.tau is None:
                return  # The client has to send torques before the cabinet follows them.
            elif _apart(answer.q, self._held) <= _NEAR:
                self.session = Session.COMMANDING_ACTIVE
                self._follow(answer)
        else:
            good = self.quality >= Quality.GOOD
            self.session = Session.MONITORING_READY if good else Session.MONITORING_WAIT
            if good and self._overlay and self.safety is Safety.NORMAL:
                self.session = Session.COMMANDING_WAIT

    def _follow(self, answer: FriCommand) -> None:
        trip = self._guard(answer)
        if trip is not None:
            self.stop(trip)
            return
        assert answer.q is not None
        moved = (new - old for new, old in zip(answer.q, self.commanded, strict=True))
        self._velocity = tuple(change / self.settings.answer_period for change in moved)
        self.commanded, self._tau = answer.q, answer.tau

    def _guard(self, answer: FriCommand) -> Trip | None:
        """Return the reason why an answer cannot be followed; None if it can be followed.

        Since the last answer, a position may have changed by at most the change that is allowed in one answer period,
        even if answers in between were missed.
        """
        limits, period = self.settings, self.settings.answer_period
        if answer.q is None:
            return Trip.NO_POSITION
        if limits.command is CommandKind.TORQUE:
            if answer.tau is None:
                return Trip.NO_TORQUE
            if any(abs(tau) > limit for tau, limit in zip(answer.tau, limits.torque, strict=True)):
                return Trip.TORQUE
        if any(not low <= q <= high for q, low, high in zip(answer.q, limits.lower, limits.upper, strict=True)):
            return Trip.POSITION
        if self.operation is Operation.T1:
            longest = _T1_SPEED * period * (1.0 + _ROUNDING)
            if self.arm.tool_way(self.commanded, answer.q) > longest:
                return Trip.T1
        for new, old, before, velocity, acceleration in zip(
            answer.q, self.commanded, self._velocity, limits.velocity, limits.acceleration, strict=True
        ):
            now = (new - old) / period
            if abs(now) > velocity * (1.0 + _ROUNDING):
                return Trip.VELOCITY
            if abs(now - before) / period > acceleration * (1.0 + _ROUNDING):
                return Trip.ACCELERATION
        return None


def _apart(one: Joints, other: Joints) -> float:
    return max(map(abs, (a - b for a, b in zip(one, other, strict=True))))
