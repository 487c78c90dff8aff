"""The interface of every plant, and the checks that keep a bad command from reaching one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Protocol, runtime_checkable

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.errors import ConfigError, PlantError, check_kind, shown
from q2r2_control.events import Reason
from q2r2_control.plugins import PLANTS, load_class
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ArmTiming, Array, Command, CommandMode, RobotState, is_number

# Longest time of one call [s]: a loop that fell further behind must not catch up in one leap.
MAX_ADVANCE = 1.0


@runtime_checkable
class Plant(Protocol):
    """A robot that moves, simulated or real. Joint arrays are (nv,) in the order of ``Robot.joint_names``.

    One tick: ``apply`` says where the plant has to be at the end of the tick, ``advance`` lets that time pass,
    ``state`` says where it got. On hardware, where time passes by itself, ``advance`` is where a plant waits for the
    next measurement. A new plant stands at home with open grippers, and stays there until a command comes. A plant
    that is found by its name has a class method ``from_config(robot, config)`` as well, and one with a window is a
    :class:`WindowedPlant`.
    """

    modes: tuple[CommandMode, ...]  # of the commands that this plant follows

    def reset(self, q: Array | None = None) -> None:
        """Start over at time 0, at rest at ``q`` (nv,) or else at home, grippers open. Raises :class:`PlantError`."""

    def apply(self, command: Command) -> None:
        """Take ``command``: posture and velocity are due at the end of the next ``advance``, a torque acts at once.

        Without a newer one, later advances hold its posture at rest, or its torque. Raises :class:`PlantError` on a
        mode that the plant does not have and on numbers that are not finite; the previous command stays in force.
        """

    def advance(self, dt: float) -> None:
        """Let ``dt`` [s], 0 .. 1, pass. Raises :class:`PlantError` on any other time; nothing moves then."""

    def state(self) -> RobotState:
        """The newest measurement; its stamp is on the plant's own clock, which starts at 0 on ``reset``.

        Its arrays stay as they are: others keep them for some ticks.
        """

    def gripper_openings(self) -> dict[str, float]:
        """Measured opening of each arm that has a gripper, 0 closed .. 1 fully open; another mapping at each call."""

    def close(self) -> None:
        """Give back every resource; may be called twice."""


@runtime_checkable
class WindowedPlant(Protocol):
    """The methods that a plant with a window has besides those of :class:`Plant`, for ``--viewer``."""

    def launch_viewer(self) -> None:
        """Open the window. Raises :class:`PlantError` where there is no display."""

    def viewer_sync(self, obstacles: Iterable[tuple[MovingObstacle, tuple[int, int, int]]] = ()) -> bool:
        """Show the plant as it is now, and ``obstacles`` in colours r g b; False once the window has been closed."""


@runtime_checkable
class SessionPlant(Protocol):
    """The methods of a plant whose arms follow only during sessions, at times of their own, besides :class:`Plant`'s.

    Its arms start where they stand. A session that ends is no end of the run: the arms of all sessions brake, and are
    activated anew where they rest, as soon as all are in a session again.
    """

    realtime_only: bool

    def begin(self, mode: CommandMode, stopped: Callable[[], bool]) -> None:
        """Commands of this ``mode`` are to come after the next ``reset``, which ends its wait if ``stopped()``."""

    def due(self, now: float) -> tuple[float, float]:
        """In a tick at ``now`` [s]: how long the reference follows its certified stop, and moves on then [s].

        The next command is for the end of both.
        """

    def withdraws(self) -> bool:
        """Whether the newest command came too late: the arms go on along the stop of the command before it."""

    def delay(self) -> float:
        """From the time that a command is for until the arms are measured there [s]."""

    def timings(self) -> dict[str, ArmTiming]:
        """Of each arm that follows the reference on its own, when it does so at the newest tick; empty: all as one."""

    def lead(self) -> float:
        """From where the arms are led at a tick to the end of the command that the tick is for, at most [s]."""

    def fault(self) -> Reason | None:
        """Why the arms cannot be commanded now, or ceased to be since the last call; None: they can."""

    def sessions(self) -> dict[str, str]:
        """Of each arm, its session in words."""


@runtime_checkable
class WaitingPlant(Protocol):
    """The attributes of a plant that waits in a reset for a person, besides those of :class:`Plant`, for ``--wait``."""

    longest_wait: float  # for the robot to be there, without which a reset raises :class:`PlantError` [s]
    longest_session_wait: float  # for all sessions, from the same moment; a run then begins without them [s]


def make_plant(plant: Plant | str, robot: Robot, config: Config) -> Plant:
    """The plant called ``plant``, or ``plant`` itself. Raises :class:`ConfigError` for an unknown name."""
    if not isinstance(plant, str):
        check_kind("plant", plant, Plant, "the name of a plant, or an object with all methods of Plant")
        return plant
    made: Plant = load_class(PLANTS, plant).from_config(robot, config)
    return made


def check_mode(mode: CommandMode | str, plant: Plant) -> CommandMode:
    """``mode`` as one that ``plant`` follows. Raises :class:`ConfigError` for any other."""
    if not isinstance(mode, str) or mode not in plant.modes:
        allowed = ", ".join(plant.modes)
        raise ConfigError(f"mode {shown(mode)}: {type(plant).__name__} follows {allowed} commands only")
    return CommandMode(mode)


def check_command(command: Command, robot: Robot, modes: tuple[CommandMode, ...]) -> None:
    """Raise :class:`PlantError` unless a plant with ``modes`` can follow ``command``."""
    check_kind("command", command, Command, "a Command", PlantError)
    check_kind("command mode", command.mode, str, ", ".join(modes), PlantError)
    if command.mode not in modes:
        allowed = ", ".join(modes)
        raise PlantError(f"command mode {command.mode!s:.40}: this plant follows {allowed} commands only")
    check_joints("command q", command.q, robot)
    check_joints("command v", command.v, robot)
    if command.mode is CommandMode.TORQUE:
        check_joints("command tau", command.tau, robot)
    check_kind("command grippers", command.grippers, dict, "openings by arm", PlantError)
    for arm, opening in command.grippers.items():
        if arm not in robot.arms:
            raise PlantError(f"command grippers: no arm {arm!r:.40}; arms: {', '.join(robot.arms)}")
        if not (isinstance(opening, float | int | np.number) and 0 <= opening <= 1):
            raise PlantError(f"command gripper of arm {arm} = {opening!r:.40}: allowed: 0 (closed) .. 1 (fully open)")


def check_joints(what: str, values: Array, robot: Robot) -> None:
    """Raise :class:`PlantError` unless ``values`` has one finite number for each joint of the robot."""
    _check_shape(what, values, robot)
    # A product is fast; squares of finite numbers may overflow.
    if not math.isfinite(values.dot(values)) and not np.isfinite(values).all():
        joint = int(np.flatnonzero(~np.isfinite(values))[0])
        raise PlantError(f"{what}: {robot.joint_names[joint]} = {values[joint]}: allowed: finite numbers")


def _check_shape(what: str, values: Array, robot: Robot) -> None:
    count = len(robot.joint_names)
    check_kind(what, values, np.ndarray, f"an array ({count},)", PlantError)
    if values.shape != (count,):
        raise PlantError(f"{what} has shape {values.shape}; expected ({count},), one value for each joint")


def check_state(state: RobotState, robot: Robot) -> RobotState:
    """The first ``state`` of a plant, of any numbers. Raises :class:`PlantError` for what is none."""
    check_kind("state() of the plant", state, RobotState, "a RobotState", PlantError)
    check_kind("stamp of the plant's state", state.stamp, (float, int, np.number), "a time [s]", PlantError)
    _check_shape("q of the plant's state", state.q, robot)
    _check_shape("v of the plant's state", state.v, robot)
    if state.tau_external is not None:
        _check_shape("tau_external of the plant's state", state.tau_external, robot)
    return state


def check_duration(dt: float) -> None:
    """Raise :class:`PlantError` unless ``dt`` is a time that a plant may be advanced by."""
    if not (is_number(dt) and 0 <= dt <= MAX_ADVANCE):
        raise PlantError(f"advance by dt = {shown(dt, 40)} s: allowed: 0 .. {MAX_ADVANCE:g} s")


class GripperMotion:
    """Openings of the grippers, moving towards the commanded ones at the configured speed."""

    def __init__(self, config: Config) -> None:
        self._rate: dict[str, float] = {
            side: arm.gripper.speed / abs(arm.gripper.open_position - arm.gripper.closed_position)
            for side, arm in config.arms.items()
            if arm.gripper.joints
        }
        self.reset()

    def reset(self) -> None:
        self.openings = dict.fromkeys(self._rate, 1.0)
        self._wanted = dict(self.openings)

    def command(self, openings: dict[str, float]) -> None:
        """Set where to go; arms without a gripper are passed over, grippers not named keep their goal."""
        for arm in self._rate:
            if arm in openings:
                self._wanted[arm] = float(openings[arm])

    def advance(self, dt: float) -> None:
        for arm, rate in self._rate.items():
            gap, reach = self._wanted[arm] - self.openings[arm], rate * dt
            self.openings[arm] += min(max(gap, -reach), reach)
