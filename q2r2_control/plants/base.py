"""The interface of every plant, and the checks that keep unusable commands from a plant."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from typing_extensions import TypeIs

from q2r2_control.config.cell import Config
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.config.plugin_settings import check_block
from q2r2_control.errors import ConfigError, PlantError, check_kind, shown
from q2r2_control.events import Reason
from q2r2_control.plugins import PLANTS, load_class
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ArmTiming, Array, Command, CommandMode, RobotState, is_number

if TYPE_CHECKING:
    from q2r2_control.plants.mujoco import MujocoPlant

# Longest time that one call of ``advance`` lets pass [s]. A loop that is farther behind must not catch up in one call.
MAX_ADVANCE = 1.0


@runtime_checkable
class Plant(Protocol):
    """A robot that moves, simulated or real. Joint arrays are (nv,) in the order of ``Robot.joint_names``.

    In each tick ``apply`` takes the posture that the plant should have at the end of the tick. ``advance`` lets the
    time of the tick pass, and ``state`` returns the measurement. The time of real hardware passes by itself, so that
    ``advance`` of such a plant waits for the next measurement. A new plant stands at home with open grippers until a
    command comes. A plant with a window is a :class:`WindowedPlant`. A plant that is found by its name also has a class
    method ``from_config(robot, config)``, in which ``config`` is the cell. Its class may have these further attributes:

    - ``settings``: The :class:`StrictModel` of its block in ``plant_settings``. The block is checked by it before
      ``from_config`` is called, and by ``q2r2 check``.
    - ``simulated``: True if its time is that of ``advance``. A run with scripted hands is then in simulated time.
    - ``realtime_only``: True if the plant's time passes by itself. Simulated time and replays are then refused.
    """

    modes: tuple[CommandMode, ...]  # The modes of commands that this plant follows.

    def reset(self, q: Array | None = None) -> None:
        """Start over at time 0, at rest at ``q`` (nv,) [rad] or at home, with open grippers; can raise PlantError."""

    def apply(self, command: Command) -> None:
        """Take a command. Posture and velocity are due at the end of the next ``advance``; a torque acts at once.

        If no newer command comes, later calls of ``advance`` keep the robot at rest in this command's posture, or keep
        applying its torque.

        Raises:
            PlantError: If the plant lacks the mode, or a number is not finite. The previous command then stays.
        """

    def advance(self, dt: float) -> None:
        """Let the time ``dt`` pass, which is from 0 to 1 s.

        Raises:
            PlantError: If ``dt`` is not in this range. Nothing moves then.
        """

    def state(self) -> RobotState:
        """Return the newest measurement, with a stamp of the plant's own clock, which starts at 0 on ``reset``.

        The plant never changes the arrays of a returned state, because the callers keep them for some ticks.
        """

    def gripper_openings(self) -> dict[str, float]:
        """Return the measured opening of each gripper, from 0 for closed to 1 for open, as a new mapping each time."""

    def close(self) -> None:
        """Free every resource. The method may be called twice."""


@runtime_checkable
class WindowedPlant(Protocol):
    """The additional methods of a plant with a window, for ``--viewer``."""

    def launch_viewer(self) -> None:
        """Open the window; raises :class:`PlantError` if there is no display."""

    def viewer_sync(self, obstacles: Iterable[tuple[MovingObstacle, tuple[int, int, int]]] = ()) -> bool:
        """Show the plant and ``obstacles``, each with its colour r g b (0 to 255).

        Returns:
            False after the window was closed.
        """


@runtime_checkable
class PicturedPlant(Protocol):
    """The additional method of a plant that draws what the simulated cameras of its cell see."""

    def picture_of(self, camera: str) -> Callable[[], npt.NDArray[np.uint8]]:
        """Return a function that draws what a camera saw when ``state`` was last called.

        The function may be called at any time and in any thread. It returns a picture (height, width, 3), r g b, or
        raises :class:`PlantError`. ``camera`` is one of the cell's ``simulated_cameras``.
        """


@runtime_checkable
class FaultReportingPlant(Protocol):
    """The additional method of a plant that can report a fault, for example a motor that is too hot.

    While the plant reports a fault, its arms are measured, but do not follow the operator. All arms brake along the
    certified stop, which the plant still has to follow, and the run goes on. When the fault is over and the arms rest,
    they are activated where they are. Each arm then waits for a new press of its operator. A plant without this method
    reports a fault by a :class:`PlantError`, which ends the run.
    """

    def fault(self) -> Reason | None:
        """Return why the arms must not follow now, or must not have followed at some time since the last call.

        The method is called at each tick, after ``state``, and returns None if there is no fault. While a fault lasts,
        each call should return an equal reason. If a run begins during a fault, each other reason is a line in the log.
        """


@runtime_checkable
class SessionPlant(FaultReportingPlant, Protocol):
    """The additional methods of a plant whose arms follow only during sessions, each arm with its own timing.

    The arms start where they stand. If the session of one arm ends, ``fault`` returns why, and all arms brake. They are
    activated again where they rest, as soon as all of them are in a session again. A simulation, or a driver whose arms
    follow every command at once, needs no sessions. It is a :class:`FaultReportingPlant`, or only a :class:`Plant`.
    """

    realtime_only: bool  # True if the plant's time passes by itself, as it does for each real robot.

    def begin(self, mode: CommandMode, stopped: Callable[[], bool]) -> None:
        """Prepare for commands of ``mode``, which come after the next ``reset``.

        The reset waits for sessions. It ends this wait as soon as ``stopped()`` returns True.
        """

    def due(self, now: float) -> tuple[float, float]:
        """Return the durations of two motions in the tick at ``now`` [s]: a certified stop, and a new motion [s].

        If a command was late, the plant already follows the certified stop, and the first duration says for how long;
        otherwise it is 0. The reference advances by both durations, and the tick's command is for their end. A plant in
        which no command can be late returns 0, and the time since the last call.
        """

    def withdraws(self) -> bool:
        """Return whether the newest command came too late. The arms then follow the stop of the command before it.

        A plant in which no command can be late returns False.
        """

    def delay(self) -> float:
        """Return the time from the moment when a command is due until the arms are measured at its posture [s].

        Targets of tools are moved ahead by this time, so that the arms do not lag behind the hands. 0 moves no target.
        """

    def timings(self) -> dict[str, ArmTiming]:
        """Return how the motion of each arm is timed relative to the reference, by the names of the arms.

        The result is empty if all arms have the same timing.
        """

    def lead(self) -> float:
        """Return the longest time from the newest posture that was sent to an arm to the end of the newest step [s].

        A command is for the end of its tick. Some plants send the arms an earlier posture on the way to it. The result
        is the time from this posture to the end of the tick. A plant that sends each command at once returns 0.
        """

    def sessions(self) -> dict[str, str]:
        """Return the state of each arm's session in words, by the names of the arms. It may be empty."""


@runtime_checkable
class RealPlant(Protocol):
    """The additional method of a plant that can drive real arms. They move slowly until the user allows more speed."""

    @classmethod
    def drives_real_arms(cls, config: Config) -> bool:
        """Return whether at least one arm of the cell ``config`` is real, and not simulated on this computer."""


@runtime_checkable
class WaitingPlant(Protocol):
    """The additional attributes of a plant whose reset waits for a person, for ``--wait``."""

    # Longest time that a reset waits for the robot [s]. After this time, the reset raises :class:`PlantError`.
    longest_wait: float
    longest_session_wait: float  # Longest time that a reset waits for all sessions [s]. A run then begins without them.


def make_plant(plant: Plant | str, robot: Robot, config: Config) -> Plant:
    """Return the plant with the name ``plant``, or ``plant`` itself.

    Raises:
        ConfigError: If no plant has this name, or if a value in its block of ``plant_settings`` is not allowed.
    """
    if not isinstance(plant, str):
        check_kind("plant", plant, Plant, "the name of a plant, or an object with all methods of Plant")
        return plant
    found = load_class(PLANTS, plant)
    check_block("plant_settings", plant, found, config.plant_settings)
    made: Plant = found.from_config(robot, config)
    return made


def is_mujoco(plant: object) -> TypeIs[MujocoPlant]:
    """Return whether ``plant`` is a :class:`~q2r2_control.plants.mujoco.MujocoPlant`, even if MuJoCo is not installed.

    Nothing is imported here, because no such plant exists before the module of the class is imported.
    """
    module = sys.modules.get(f"{__package__}.mujoco")
    return module is not None and isinstance(plant, module.MujocoPlant)


def check_mode(mode: CommandMode | str, plant: Plant) -> CommandMode:
    """Return ``mode`` if the plant follows it; raises :class:`ConfigError` if not."""
    if not isinstance(mode, str) or mode not in plant.modes:
        allowed = ", ".join(plant.modes)
        raise ConfigError(f"mode {shown(mode)}: {type(plant).__name__} follows {allowed} commands only")
    return CommandMode(mode)


def keeps_jerk_limit(plant: Plant, mode: CommandMode) -> bool:
    """Return whether commands reach the arms within ``control.jerk_limit``; True in torque mode, which has no limit.

    For most plants, the loop's drive averages the commands, and the averages keep the limit. A :class:`SessionPlant`
    executes the certified stop by itself, so that the drive cannot average this motion. Such a plant keeps the limit
    only if it averages what it sends to the arms. It then has an attribute ``averages``, which is True.
    """
    return mode is CommandMode.TORQUE or not isinstance(plant, SessionPlant) or getattr(plant, "averages", False)


def check_command(command: Command, robot: Robot, modes: tuple[CommandMode, ...]) -> None:
    """Raise :class:`PlantError` if a plant with ``modes`` cannot follow ``command``."""
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
    """Raise :class:`PlantError` if ``values`` does not have one finite number for each joint of the robot."""
    _check_shape(what, values, robot)
    # A scalar product is a fast test. But the squares of large finite numbers can overflow. The numbers themselves are
    # therefore checked if the product is not finite.
    if not math.isfinite(values.dot(values)) and not np.isfinite(values).all():
        joint = int(np.flatnonzero(~np.isfinite(values))[0])
        raise PlantError(f"{what}: {robot.joint_names[joint]} = {values[joint]}: allowed: finite numbers")


def _check_shape(what: str, values: Array, robot: Robot) -> None:
    count = len(robot.joint_names)
    check_kind(what, values, np.ndarray, f"an array ({count},)", PlantError)
    if values.shape != (count,):
        raise PlantError(f"{what} has shape {values.shape}; expected ({count},), one value for each joint")


def check_state(state: RobotState, robot: Robot) -> RobotState:
    """Return ``state``, the first state of a plant, if its types and shapes are right. NaN and infinity are allowed.

    Raises:
        PlantError: If ``state`` is not a RobotState with arrays of the robot's shape.
    """
    check_kind("state() of the plant", state, RobotState, "a RobotState", PlantError)
    check_kind("stamp of the plant's state", state.stamp, (float, int, np.number), "a time [s]", PlantError)
    _check_shape("q of the plant's state", state.q, robot)
    _check_shape("v of the plant's state", state.v, robot)
    if state.tau_external is not None:
        _check_shape("tau_external of the plant's state", state.tau_external, robot)
    return state


def check_duration(dt: float) -> None:
    """Raise :class:`PlantError` if a plant may not be advanced by ``dt``."""
    if not (is_number(dt) and 0 <= dt <= MAX_ADVANCE):
        raise PlantError(f"advance by dt = {shown(dt, 40)} s: allowed: 0 .. {MAX_ADVANCE:g} s")


class GripperMotion:
    """Simulated openings of grippers, which move to the commanded openings at the configured speed."""

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
        """Set the commanded openings. Entries of arms without a gripper are ignored.

        A gripper without an entry keeps the opening that was commanded before.
        """
        for arm in self._rate:
            if arm in openings:
                self._wanted[arm] = float(openings[arm])

    def advance(self, dt: float) -> None:
        for arm, rate in self._rate.items():
            change, largest = self._wanted[arm] - self.openings[arm], rate * dt
            self.openings[arm] += min(max(change, -largest), largest)
