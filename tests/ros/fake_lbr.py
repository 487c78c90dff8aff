"""One arm behind lbr_fri_ros2_stack: its sessions, its filter, and the guards that shut the connection."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from lbr_fri_idl.msg import LBRState
from sensor_msgs.msg import JointState

from q2r2_control import Robot
from q2r2_control.plants.fri.wire import CommandKind, Drives, Operation, Quality, Safety, Session
from q2r2_control.types import Array

PERIOD = 0.005  # of the driver [s]
TAU = 0.04  # of its filter of positions, by default [s]
NARROWER = math.radians(1.0)  # than the model's limits are the driver's [rad]
SAME = 3e-4  # of a first command and the cabinet's own position: a step from rest, where it is outside a limit [rad]
SAG = 2e-3  # of the measured joints below what is commanded [rad]
BRAKES = 10.0  # a cabinet whose client is gone [rad/s^2]
TOPICS = {"for Jazzy": ("lbr_joint_position_command", "lbr_state"), "of 2024": ("joint_position", "state")}
_ROUNDING = 1e-6  # relative, of the limits
_ORDER = [2, 0, 1, 3, 4, 6, 5]  # of the joints in its joint states


class FakeLbr:
    """Follows commands in commanding active only. Everything that would shut the connection is in ``trips``."""

    def __init__(self, robot: Robot, arm: str, tau: float = TAU) -> None:
        """``tau``: of the filter of positions [s]."""
        joints = robot.arms[arm].joints
        self._share = 1.0 if tau == 0.0 else 1.0 - math.exp(-PERIOD / tau)  # of the way, in one period
        self.q, self.v = robot.home[joints].copy(), np.zeros(len(joints))  # as commanded to the cabinet [rad], [rad/s]
        self.session, self.quality, self.safety = Session.MONITORING_READY, Quality.EXCELLENT, Safety.NORMAL
        self.drives, self.operation = Drives.ACTIVE, Operation.AUTOMATIC
        self.silent = False  # its process has ended
        self.begun, self.trips = 0, list[str]()
        self.target: Array | None = None  # the newest command of this session
        self.ipo = self.q  # of the cabinet's own motion, which stays where the session began: commands overlay it
        self._fastest = robot.velocity_limit[joints] * (1.0 + _ROUNDING)
        away = NARROWER + self._fastest * PERIOD  # of its guard safe_stop, the narrower one
        self._lower, self._upper = robot.position_lower[joints] + away, robot.position_upper[joints] - away

    def begin(self) -> None:
        """Commanding active, as after a press on the pendant; the driver was started anew."""
        self.quality, self.safety, self.drives = Quality.EXCELLENT, Safety.NORMAL, Drives.ACTIVE
        self.target, self.v, self.ipo = None, np.zeros_like(self.q), self.q
        self.session, self.silent = Session.COMMANDING_ACTIVE, False
        self.begun += 1

    def drop(self, session: Session = Session.MONITORING_READY) -> None:
        self.session, self.target = session, None

    def take(self, message: Any) -> None:
        """A command."""
        q = np.array(message.joint_position)
        if self.session is not Session.COMMANDING_ACTIVE:
            return
        if self.target is None and np.abs(q - self.ipo).max() > SAME:
            self._trip(f"first command {q}, and the arm is held at {self.ipo}")
        self.target = q

    def advance(self) -> None:
        """One period: towards the newest command, or to rest by the cabinet's own brakes."""
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
