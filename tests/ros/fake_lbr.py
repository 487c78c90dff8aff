"""One arm behind lbr_fri_ros2_stack: its sessions, its filter, and the guards that end the connection."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from lbr_fri_idl.msg import LBRState
from sensor_msgs.msg import JointState

from q2r2_control import Robot
from q2r2_control.plants.fri.wire import CommandKind, Drives, Operation, Quality, Safety, Session
from q2r2_control.types import Array

PERIOD = 0.005  # Period of the driver [s].
TAU = 0.04  # Default time constant of the driver's filter of positions [s].
NARROWER = math.radians(1.0)  # The driver's limits are narrower than the model's by this angle [rad].
SAME = 3e-4  # Largest permitted difference between a first command and the cabinet's own position [rad].
SAG = 2e-3  # The measured joints hang this far below their commands [rad].
BRAKES = 10.0  # Deceleration of a cabinet whose client is gone [rad/s^2].
TOPICS = {"for Jazzy": ("lbr_joint_position_command", "lbr_state"), "of 2024": ("joint_position", "state")}
_ROUNDING = 1e-6  # Relative tolerance of the limits.
_ORDER = [2, 0, 1, 3, 4, 6, 5]  # Order of the joints in the driver's joint states.


class FakeLbr:
    """A driver that follows commands only in the session state commanding active.

    ``trips`` lists everything that would end the connection.
    """

    def __init__(self, robot: Robot, arm: str, tau: float = TAU) -> None:
        """The time constant of the filter of positions is ``tau`` [s]."""
        joints = robot.arms[arm].joints
        # Share of the distance to the command that the filter covers in a period.
        self._share = 1.0 if tau == 0.0 else 1.0 - math.exp(-PERIOD / tau)
        # Positions and velocities as commanded to the cabinet [rad], [rad/s].
        self.q, self.v = robot.home[joints].copy(), np.zeros(len(joints))
        self.session, self.quality, self.safety = Session.MONITORING_READY, Quality.EXCELLENT, Safety.NORMAL
        self.drives, self.operation = Drives.ACTIVE, Operation.AUTOMATIC
        self.silent = False  # If True, the driver's process has ended.
        self.begun, self.trips = 0, list[str]()
        self.target: Array | None = None  # The newest command of this session.
        self.ipo = self.q  # The cabinet's own position stays where the session began [rad]. Commands are added to it.
        self._fastest = robot.velocity_limit[joints] * (1.0 + _ROUNDING)
        away = NARROWER + self._fastest * PERIOD  # The driver's guard safe_stop has this narrower limit.
        self._lower, self._upper = robot.position_lower[joints] + away, robot.position_upper[joints] - away

    def begin(self) -> None:
        """Enter commanding active, as after a restart of the driver and a press on the pendant."""
        self.quality, self.safety, self.drives = Quality.EXCELLENT, Safety.NORMAL, Drives.ACTIVE
        self.target, self.v, self.ipo = None, np.zeros_like(self.q), self.q
        self.session, self.silent = Session.COMMANDING_ACTIVE, False
        self.begun += 1

    def drop(self, session: Session = Session.MONITORING_READY) -> None:
        self.session, self.target = session, None

    def take(self, message: Any) -> None:
        """Take a command."""
        q = np.array(message.joint_position)
        if self.session is not Session.COMMANDING_ACTIVE:
            return
        if self.target is None and np.abs(q - self.ipo).max() > SAME:
            self._trip(f"first command {q}, and the arm is held at {self.ipo}")
        self.target = q

    def advance(self) -> None:
        """Advance by one period, towards the newest command or to rest by the cabinet's own brakes."""
        if self.session is not Session.COMMANDING_ACTIVE:
            self.v = np.sign(self.v) * np.maximum(np.abs(self.v) - BRAKES * PERIOD, 0.0)
        elif self.target is not None:
            q = self.q + self._share * (self.target - self.q)
            self.v = (q - self.q) / PERIOD
            if not ((self._lower <= q) & (q <= self._upper)).all():
                self._trip(f"position {q}")
            if (np.abs(self.v) > self._fastest).any():
                self._trip(f"velocity {self.v}")
        self.q = self.q + self.v * PERIOD

    def state(self) -> LBRState:
        return LBRState(
            session_state=int(self.session),
            connection_quality=int(self.quality),
            safety_state=int(self.safety),
            drive_state=int(self.drives),
            operation_mode=int(self.operation),
            client_command_mode=int(CommandKind.POSITION),
            ipo_joint_position=self.ipo,
        )

    def joint_state(self) -> JointState:
        names = [f"lbr_A{number + 1}" for number in _ORDER]
        return JointState(name=names, position=(self.q - SAG)[_ORDER].tolist(), velocity=self.v[_ORDER].tolist())

    def _trip(self, what: str) -> None:
        self.trips.append(what)
