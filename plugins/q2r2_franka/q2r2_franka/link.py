"""The connection to one robot by pylibfranka. Only this module and hand.py call this library.

pylibfranka keeps Python's global lock while it waits for a state. With one thread for each arm, the threads would delay
each other. The process therefore waits for the sockets of all robots together by ``select``, and reads a state only
when it has come. pylibfranka does not say which socket it uses. The socket is therefore found among the files that a
connection opens.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from typing import Any

import pylibfranka

from q2r2_control import CommandMode, PlantError
from q2r2_franka.limits import PERIOD
from q2r2_franka.settings import FrankaArmSettings, LoadSettings
from q2r2_franka.state import Measured, Mode

# The library raises ValueError for a command that is not finite.
ERRORS = (RuntimeError, ValueError, pylibfranka.FrankaException)
_FILES = "/proc/self/fd"
# The robot's own controller of joint positions. Settings in Desk may let this controller filter the commands. Its
# stiffness is not changed here.
_CONTROLLER = pylibfranka.ControllerMode.JointImpedance
# Python objects of lost connections. They must not be destroyed, because that would end the process.
_kept: list[Any] = []


class ArmLink:
    """The connection to one robot. Each method may raise one of ``ERRORS``."""

    def __init__(self, settings: FrankaArmSettings, enforces_real_time: bool) -> None:
        self._settings = settings
        self._real_time = (
            pylibfranka.RealtimeConfig.kEnforce if enforces_real_time else pylibfranka.RealtimeConfig.kIgnore
        )
        self._robot: Any = None
        self._motion: Any = None
        self._last = 0.0  # Time of the newest state by the robot's clock [s].
        self.file = -1  # File descriptor of the socket for states; -1 without a connection.

    @property
    def is_open(self) -> bool:
        return self._robot is not None

    def open(self) -> None:
        """Connect, and set the robot's collision thresholds and load to the values in the cell."""
        before = _datagram_sockets()
        try:
            robot = pylibfranka.Robot(self._settings.address, self._real_time)
        except pylibfranka.RealtimeException as error:
            cure = "a kernel with PREEMPT_RT, or plant_settings.franka.real_time: ignore for a first look"
            raise PlantError(f"{str(error).rstrip('.')}; allowed: {cure}") from error
        opened = _datagram_sockets() - before
        if len(opened) != 1:
            raise PlantError(f"pylibfranka opened {len(opened)} sockets for states; allowed: one")
        collision, load = self._settings.collision, self._settings.load
        torques, forces = list(collision.torques), list(collision.forces)
        robot.set_collision_behavior(torques, torques, forces, forces)
        if load is not None:
            robot.set_load(load.mass, list(load.centre), _matrix(load))
        self._robot, self.file = robot, opened.pop()

    def lose(self) -> None:
        """Drop a connection that is lost."""
        _kept.extend(one for one in (self._motion, self._robot) if one is not None)
        self._robot = self._motion = None
        self.file = -1

    def read(self) -> Measured:
        """Return the newest state. If there is none, wait for the next state."""
        state = self._robot.read_once() if self._motion is None else self._motion.readOnce()[0]
        now = state.time.to_sec()
        cycles, self._last = max(round((now - self._last) / PERIOD), 1), now
        return Measured(
            mode=Mode(state.robot_mode.name),
            errors="" if not state.current_errors else str(state.current_errors).strip("[]"),
            cycles=cycles,
            q=tuple(state.q),
            v=tuple(state.dq),
            tau=tuple(state.tau_J),
            external=tuple(state.tau_ext_hat_filtered),
            held=tuple(state.q_d),
            held_tau=tuple(state.tau_J_d),
        )

    def start(self, mode: CommandMode) -> Measured:
        """Begin a motion, and return the robot's first state in this motion."""
        if mode is CommandMode.TORQUE:
            self._motion = self._robot.start_torque_control()
        else:
            self._motion = self._robot.start_joint_position_control(_CONTROLLER)
        self._mode = mode
        return self.read()

    def write(self, values: Sequence[float], finished: bool = False) -> None:
        """Send positions (7,) [rad] or torques (7,) [Nm].

        With ``finished``, the motion ends, and the robot holds the arm from then on.
        """
        kind = pylibfranka.Torques if self._mode is CommandMode.TORQUE else pylibfranka.JointPositions
        command = kind(list(values))
        command.motion_finished = finished
        self._motion.writeOnce(command)
        if finished:
            self._motion = None

    def drop_motion(self) -> None:
        """Drop the motion, because the robot has ended it."""
        if self._motion is not None:
            _kept.append(self._motion)
            self._motion = None

    def recover(self) -> None:
        """Clear the errors of a reflex. Afterwards the robot holds the arm."""
        _kept.clear()
        self._robot.automatic_error_recovery()


def _matrix(load: LoadSettings) -> list[float]:
    xx, xy, xz, yy, yz, zz = load.inertia
    return [xx, xy, xz, xy, yy, yz, xz, yz, zz]


def _datagram_sockets() -> set[int]:
    found = set()
    for name in os.listdir(_FILES):
        try:
            if not os.readlink(f"{_FILES}/{name}").startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(name))) as one:
                if one.family in (socket.AF_INET, socket.AF_INET6) and one.type == socket.SOCK_DGRAM:
                    found.add(int(name))
        except OSError:  # The file was closed meanwhile.
            continue
    return found
