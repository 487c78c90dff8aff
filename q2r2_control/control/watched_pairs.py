"""The pairs of bodies that a controller keeps apart, their distances, and the bodies that change between steps."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.config.moving_obstacle import MovingObstacle, ObstacleReport
from q2r2_control.control.geometry.finger_openings import FingerOpenings
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.jit import bound
from q2r2_control.control.kernel_model import KernelData, KernelModel, kernel_model_of
from q2r2_control.control.kernel_pointers import pointer_to
from q2r2_control.control.live_settings import LiveSettings, ObjectPairs
from q2r2_control.control.moving_obstacles import MovingObstacles
from q2r2_control.control.reference import observe_bodies, spare_distance
from q2r2_control.control.safety.protective_distance import ObstacleData
from q2r2_control.control.safety.reference_history import LONGEST_WINDOW
from q2r2_control.control.safety.safety_data import ROUNDING
from q2r2_control.control.step_report import LimitNames
from q2r2_control.errors import RobotError, shown
from q2r2_control.robot.obstacle_bodies import distances_with, roles_with_obstacles, with_obstacle_bodies
from q2r2_control.robot.pairs import pairs_with_others
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Interval

# Two things: a function that returns the distances of pairs (p,) [m] at a posture (nv,) [rad], and an array of the
# distances (p,) [m] that these pairs have to keep.
PairsAhead = tuple[Callable[[Array], Array], Array]


class WatchedPairs:
    """Fingers, held objects and moving obstacles of a controller, and the distances that all pairs keep."""

    def __init__(self, robot: Robot, settings: ControllerSettings) -> None:
        self.robot, self._arms = robot, tuple(robot.arms)
        model = kernel_model_of(robot, settings)
        data, bodies = KernelData.empty(model), model.safety.collision.bodies
        self._model_pointer, self._data_pointer = pointers = pointer_to(model), pointer_to(data)
        self._objects = ObjectPairs(robot, settings, model, data)
        self._live = LiveSettings(robot, settings, model, data, self._objects)
        geometry = with_obstacle_bodies(robot, settings.moving_obstacles)
        self._obstacles = MovingObstacles(robot, settings, pointers, geometry)
        self._fingers = FingerOpenings(robot, bodies)
        self._state, self._active, self._stop = data.safety.state, data.safety.active, data.safety.certified
        self._unchanged: IntArray = np.zeros(len(bodies.joint), dtype=np.int64)
        self._names = LimitNames(robot, geometry)
        roles = roles_with_obstacles(robot, settings.moving_obstacles)
        self._with_others = {arm: pairs_with_others(self._names.pairs, roles, arm) for arm in self._arms}
        self._observe_bodies = bound(observe_bodies, *pointers, self._unchanged)
        self._spare = bound(spare_distance, *pointers, self._with_others[self._arms[0]])
        self._certified = False
        self._observe_again(self._unchanged)

    @property
    def kept_distances(self) -> Array:
        """Distance that every monitored pair keeps now (p,) [m]. Each change makes a new array."""
        return self._live.kept

    @property
    def narrow_pair(self) -> tuple[str, str] | None:
        """The pair whose kept distance is farthest below the requested distance; None if there is no such pair."""
        return None if self._live.narrow < 0 else self._names.pair(self._live.narrow)

    def set_opening(self, arm: str, least: float, greatest: float) -> tuple[str, str] | None:
        """Declare that the gripper of an arm is, and stays, between two openings.

        From the next step on, the bodies of its fingers are the volume that the fingers sweep between the two openings.
        At first, and after :meth:`reset`, it is the volume between fully closed and fully open. A part of the present
        volume is always accepted. Another volume is accepted if every pair keeps its distance with it, at the reference
        and during the certified stop from it. The caller may send the gripper only to openings that were accepted.

        Args:
            arm: The arm.
            least: The least opening, from 0 for closed to 1 for fully open.
            greatest: The greatest opening.

        Returns:
            None if the openings were accepted; otherwise a pair that does not allow them, and nothing has changed.

        Raises:
            RobotError: If there is no such arm, or the numbers are not an interval within 0 .. 1.
        """
        self.robot.arm(arm)
        interval, before = self._fingers.checked(arm, least, greatest), self._fingers.intervals[arm]
        if interval == before:
            return None
        blocked = self._observe_again(self._fingers.set(arm, interval))
        if blocked < 0:
            return None
        self._fingers.set(arm, before)
        self._observe_again(self._unchanged)
        return self._names.pair(blocked)

    @property
    def openings(self) -> dict[str, Interval]:
        """For each arm, the least and the greatest opening of its gripper that :meth:`set_opening` accepted."""
        return dict(self._fingers.intervals)

    def set_holding(self, arm: str, holds: bool) -> None:
        """Declare that the gripper of an arm holds its object from the next step on, or no longer holds it.

        A held object is part of the tool. At first, each of its pairs keeps at most its present distance. The kept
        distance (:attr:`object_distances`) grows with the distance, up to the distance of the pair's class. The object
        is therefore always accepted, and no arm has to move because of it. After :meth:`reset` no object is held.

        Raises:
            RobotError: If the arm has no object.
        """
        if not self._objects.set_holding(arm, holds):
            return
        self._active.used[0] = 0  # Pairs that were active in the last step may no longer be monitored.
        self._obstacles.hold(self._objects.holding)
        self._observe_again(self._unchanged)
        self._objects.begin()
        self._observe_again(self._unchanged)

    @property
    def holding(self) -> dict[str, bool]:
        """For each arm that has an object, whether its gripper holds the object, by the last :meth:`set_holding`."""
        return {arm: arm in self._objects.holding for arm in self.robot.objects.by_arm}

    @property
    def object_distances(self) -> Array:
        """Distance that every pair of ``Robot.objects`` keeps now (pairs,) [m]; -inf while the object is not held."""
        return self._objects.kept.copy()

    def move_obstacle(self, name: str, obstacle: MovingObstacle | None) -> tuple[str, str] | None:
        """Report where a moving obstacle is and how fast it may move. The report counts from the next step on.

        The arms keep away from all positions that the obstacle can reach before they rest, and slow down as it comes
        nearer. No report is refused.

        Args:
            name: One of ``ControllerSettings.moving_obstacles``.
            obstacle: The obstacle; None if it has gone.

        Returns:
            None, or a pair for which the certified stop may end too late: the obstacle could reach the arm earlier.
            This happens if an obstacle appears in front of a moving arm.

        Raises:
            ConfigError: If there is no such name.
        """
        changed = self._obstacles.put(name, obstacle)
        self._active.used[0] = 0  # Pairs that were active in the last step may no longer be monitored.
        blocked = self._observe_again(changed) if self._state.v.any() else -1
        self._certified &= blocked < 0
        self._obstacles.keep_clear(0.0)
        self._observe_again(self._unchanged)
        return None if blocked < 0 else self._names.pair(blocked)

    def pass_time(self, time: float) -> None:
        """Let reports of moving obstacles age by ``time`` [s] in which no step is taken.

        Raises:
            RobotError: If ``time`` is not a number of seconds, 0 or more.
        """
        if not (isinstance(time, float | int) and 0.0 <= time < np.inf):
            raise RobotError(f"time = {shown(time)}: allowed: seconds, 0 or more")
        self._obstacles.pass_time(time)

    @property
    def skew(self) -> float:
        """Greatest difference between the delays of two arms behind the reference [s]; 0 if the delays are equal."""
        return float(self._data_pointer.value.safety.history.window[0])

    def allow_skew(self, time: float) -> None:
        """Let the arms' delays behind the reference differ by up to ``time`` [s], and let each arm stop on its own.

        From the next step on, the bodies of two arms keep their distance wherever each of the two arms is on its own
        path. A path begins where the reference was ``time`` [s] ago, and ends where the certified stop ends. A greater
        time takes effect gradually as time passes, and a smaller time at once. After :meth:`reset` the whole time
        counts at once.

        Args:
            time: The difference, from 0 to 0.1 [s].

        Raises:
            RobotError: If ``time`` is not such a number.
        """
        if not (isinstance(time, float | int) and 0.0 <= time <= LONGEST_WINDOW):
            raise RobotError(f"skew = {shown(time)}: allowed: seconds, 0 to {LONGEST_WINDOW:g}")
        self._data_pointer.value.safety.history.window[1] = time

    def pairs_ahead(self, stop: float) -> PairsAhead:
        """Return the function and the distances with which a path is checked before the arms follow it.

        See :data:`PairsAhead`. Held objects count, and moving obstacles count where they were reported last.

        Args:
            stop: Time in which the arms stop on that path [s].
        """
        kept = self.kept_distances, self._objects.kept, self._obstacles.kept_from(stop)
        return distances_with(self.robot, self.moving_obstacles), np.concatenate(kept)

    @property
    def moving_obstacles(self) -> dict[str, MovingObstacle]:
        """The moving obstacles that are present, by name, from the last calls of :meth:`move_obstacle`."""
        return dict(self._obstacles.there)

    @property
    def obstacle_reports(self) -> dict[str, ObstacleReport]:
        """The moving obstacles that are present, by name, with the present age of their reports."""
        return self._obstacles.reports

    def spare_distance(self, arm: str) -> float:
        """Return the least margin of an arm's pairs with other bodies at the reference [m]; infinite without a pair.

        Raises:
            RobotError: If there is no such arm.
        """
        return float(self._spare(self._model_pointer, self._data_pointer, self._with_others[self.robot.arm(arm).name]))

    @property
    def still_obstacles(self) -> Mapping[str, MovingObstacle]:
        """The :attr:`moving_obstacles` whose reported speed is 0. Each change makes a new mapping."""
        return self._obstacles.still

    @property
    def _kernel_values(self) -> tuple[KernelModel, KernelData, ObstacleData]:
        """All arrays that kernels read and write, except the targets."""
        return self._model_pointer.value, self._data_pointer.value, self._obstacles.data

    def _observe_again(self, grown: IntArray) -> int:
        """Update the distances after a change; return the pair that does not allow the ``grown`` bodies, or -1."""
        self._observed, blocked = self._observe_bodies(self._model_pointer, self._data_pointer, grown)
        self._apart = self._observed[-1] >= -ROUNDING
        return int(blocked)
