"""Sessions of two KUKA drivers that end in every possible way."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from q2r2_control.plants.fri.wire import Drives, Operation, Quality, Safety, Session
from q2r2_control.supervision.supervisor import Phase
from q2r2_control.types import SIDES, Array
from tests.ros.fake_lbr import SAME, TOPICS
from tests.ros.virtual_lbrs import Operator, VirtualLbrs

_NEAR = 1e-9  # Relative tolerance of limits.
_UNEVEN = 0.004  # Relative tolerance of the time between two ticks, because the node's clock makes it uneven.
_NOTICED = 0.15  # Time until the end of a session is noticed, by late states or by a silence of 0.1 s [s].
_RESTARTED = 1.0  # Shortest time until a driver's process is restarted [s].
_ALLOWANCE = 0.2  # Braking is allowed to last longer than the certified stop by this time [s].
_LONGEST_STOP = 1.0  # Longest time from the end of a session to rest [s].
_CREEPS = 1e-3  # A slower joint counts as resting [rad/s].
_STUCK = 20.0  # If nothing moves in a session for this time, the soak has failed [s].


@dataclass
class LbrSoak:
    """A soak that begins both sessions, lets the arms move for a while, and ends one or both for a random cause."""

    virtual: VirtualLbrs
    sessions: int
    ended: int = 0
    activations: int = 0
    moved: float = 0.0  # Speed of the fastest joint of a driver [rad/s].
    faults: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.operator, self.random = Operator(self.virtual), self.virtual.random
        self._how, self._ends_at, self._progress = "start", math.inf, self.virtual.now
        self._phase, self._seen = Phase.INACTIVE, dict.fromkeys(SIDES, 0)
        self._commands: dict[str, tuple[int, int, Array, Array]] = {}  # The newest command: session, tick, q, v.
        self._late = 0  # The number of the last tick that was late.
        self._brakings = 0  # Number of brakings so far.
        self._disturbed = 0.0  # Until this time, the end of a session need not be noticed [s].
        self.virtual.on_command = self._on_command
        robot, node = self.virtual.robot, self.virtual.node
        self._fastest = robot.velocity_limit * node._controller.settings.velocity_scale * (1.0 + _NEAR)
        self._acceleration = node._loop.acceleration_limit * (1.0 + _UNEVEN)
        self._rearm(*SIDES)
        self._look()

    def run(self) -> LbrSoak:
        self.virtual.run(lambda: self.ended >= self.sessions or self._progress + _STUCK < self.virtual.now)
        if self.ended < self.sessions:
            self._fault(f"nothing moves for {_STUCK:g} s: {self.virtual.node._supervisor.fault}")
        return self

    def _fault(self, what: str) -> None:
        self.faults.append(f"{self.virtual.now:.3f} s, session {self.ended}, {self._how}: {what}")

    def _on_command(self, arm: str, q: Array) -> None:
        """Check a command when it is sent. Its step must keep the limits of the reference, and it must not jump."""
        node, joints, session = self.virtual.node, self.virtual.robot.arms[arm].joints, self.virtual.drivers[arm].begun
        tick, v = node._advances, np.full(len(q), math.nan)
        if arm in self._commands:
            before, last, last_q, last_v = self._commands[arm]
            if last == tick - 1:
                v = (q - last_q) / node._period
                a, allowed = (
                    (v - last_v) / node._period,
                    self._acceleration[joints] + _UNEVEN * np.abs(v) / node._period,
                )
                if (np.abs(v) > self._fastest[joints]).any():
                    self._fault(f"{arm} is commanded to move at {v}")
                if tick - self._late > 2 and (np.abs(a) > allowed).any():
                    self._fault(f"{arm} is commanded to accelerate at {a}")
            elif before == session and np.abs(q - last_q).max() > SAME:
                self._fault(f"{arm} is commanded to {q}, and was left at {last_q}")
        self._commands[arm] = session, tick, q, v

    def _look(self) -> None:
        """Check the arms a hundred times a second."""
        virtual, now = self.virtual, self.virtual.now
        virtual.at(now + 0.01, self._look)
        for arm, driver in virtual.drivers.items():
            for trip in driver.trips[self._seen[arm] :]:
                self._fault(f"{arm} shuts the connection: {trip}")
            self._seen[arm] = len(driver.trips)
            if driver.session is Session.COMMANDING_ACTIVE:
                self.moved = max(self.moved, float(np.abs(driver.v).max()))
        phase = virtual.node._supervisor.phase
        self.activations += phase is Phase.ACTIVE and self._phase is not Phase.ACTIVE
        if phase is Phase.BRAKING and self._phase is not Phase.BRAKING:
            braking = np.abs(virtual.node._loop._velocity) / virtual.node._controller.stop_deceleration
            self._brakings += 1
            virtual.at(now + float(braking.max()) + _ALLOWANCE, partial(self._check_rest, self._brakings))
        self._phase = phase
        followed = self.operator.moves and all(map(virtual.node._supervisor.follows, SIDES))
        if self._ends_at == math.inf and now > self._disturbed and followed:
            self._ends_at, self._progress = now + float(self.random.uniform(0.2, 1.2)), now
        elif now >= self._ends_at:
            self._ends_at = math.inf
            self._end_session()
            self.ended += 1

    def _end_session(self) -> None:
        virtual, random = self.virtual, self.random
        self._how = str(random.choice(_ENDS))
        arm, pause = str(random.choice(SIDES)), float(random.uniform(0.02, 0.5))
        self._disturbed = virtual.now + max(pause, _NOTICED)
        if self._how == "the node freezes":
            virtual.frozen_until = virtual.now + pause
            virtual.at(virtual.frozen_until + 1e-6, self._note_late)
        elif self._how in _CHANGES:
            topics, change = _CHANGES[self._how]
            where = [f"/{one}/{name}" for one in (arm, *(SIDES if pause > 0.3 else ())) for name in topics]
            virtual.change = lambda topic, message: change(message) if topic in where else message
            virtual.at(virtual.now + pause, self._change_nothing)
        else:
            self._drop(arm)

    def _note_late(self) -> None:
        self._late = self.virtual.node._advances + 1

    def _change_nothing(self) -> None:
        self.virtual.change = lambda topic, message: message

    def _drop(self, arm: str) -> None:
        virtual, random = self.virtual, self.random
        arms = SIDES if self._how in ("both sessions end", "both arms are moved") else (arm,)
        for one in arms:
            driver = virtual.drivers[one]
            driver.drop(Session.MONITORING_WAIT if self._how == "the quality falls" else Session.MONITORING_READY)
            if self._how == "the quality falls":
                driver.quality = Quality(int(random.integers(0, 2)))
            elif self._how == "a safety stop":
                driver.safety, driver.drives = Safety.STOP_1_ON_PATH, Drives.OFF
            elif self._how == "T1":
                driver.operation = Operation(0 if driver.operation else 2)
            driver.silent = self._how == "a driver ends"
        virtual.at(virtual.now + _NOTICED, self._check_noticed)
        self.operator.not_before = rests = virtual.now + _LONGEST_STOP
        if self._how == "both arms are moved":
            virtual.at(rests, partial(self._move, random.uniform(-0.3, 0.3, (2, 7)) / 30, 30))
            virtual.at(rests + 0.4, partial(self._rearm, *SIDES))
        else:
            virtual.at(virtual.now + (_RESTARTED if self._how == "a driver ends" else 0.0), partial(self._rearm, *arms))

    def _move(self, by: Array, times: int) -> None:
        """Move both arms by small steps, as in hand guiding, within the limits of the controller."""
        margin, robot = self.virtual.node._controller.settings.position_margin, self.virtual.robot
        for (arm, driver), step in zip(self.virtual.drivers.items(), by, strict=True):
            joints = robot.arms[arm].joints
            driver.q = np.clip(
                driver.q + step, robot.position_lower[joints] + margin, robot.position_upper[joints] - margin
            )
        if times > 1:
            self.virtual.at(self.virtual.now + 0.01, partial(self._move, by, times - 1))

    def _rearm(self, *arms: str) -> None:
        """Begin the sessions of ``arms`` at different random times. A cabinet begins when its arm is at rest."""
        for arm in arms:
            self.virtual.at(self.virtual.now + float(self.random.uniform(0.05, 0.6)), partial(self._begin, arm))

    def _begin(self, arm: str) -> None:
        driver = self.virtual.drivers[arm]
        if driver.v.any():
            self.virtual.at(self.virtual.now + 0.01, partial(self._begin, arm))
        elif not driver.silent and driver.session is not Session.COMMANDING_WAIT:
            driver.session = Session.COMMANDING_WAIT
            self.virtual.at(self.virtual.now + float(self.random.uniform(0.01, 0.1)), partial(self._begin, arm))
        else:
            driver.begin()

    def _check_noticed(self) -> None:
        if self.virtual.node._supervisor.phase is Phase.ACTIVE:
            self._fault(f"the controller is active {_NOTICED:g} s after that")

    def _check_rest(self, braking: int) -> None:
        """Check the arms after the braking time.

        The controller is allowed to be active, to brake again, or to let a joint creep to its goal.
        """
        node = self.virtual.node
        fastest = float(np.abs(node._loop._velocity).max())
        if node._supervisor.phase is Phase.BRAKING and braking == self._brakings and fastest > _CREEPS:
            self._fault(f"the reference moves at {fastest:.4f} rad/s after the time to brake")


def _lost(message: Any) -> Any:
    return None


def _with(**changes: Any) -> Callable[[Any], Any]:
    def change(message: Any) -> Any:
        for name, value in changes.items():
            setattr(message, name, value)
        return message

    return change


_STATES = [name for _, name in TOPICS.values()]
_CHANGES = {
    "a driver is silent": ([*_STATES, "joint_states"], _lost),
    "session states cease": (_STATES, _lost),
    "joint states cease": (["joint_states"], _lost),
    "joint states are no numbers": (["joint_states"], _with(position=[math.nan] * 7)),
    "joint states lack joints": (["joint_states"], _with(name=["lbr_A1"] * 7)),
    "session states are no numbers": (_STATES, _with(ipo_joint_position=[math.nan] * 7)),
    "session states cannot be read": (_STATES, _with(session_state=7, connection_quality=-1)),
}
_ENDS = (
    *("a session ends", "both sessions end", "the quality falls", "a safety stop", "T1", "both arms are moved"),
    *("a driver ends", "the node freezes", *_CHANGES),
)
