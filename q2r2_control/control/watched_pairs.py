"""Pairs that a controller keeps apart: how far, and those of its bodies that change between steps."""

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

# Measures pairs at a posture (nv,), and what each of them has to keep there (p,) [m].
PairsAhead = tuple[Callable[[Array], Array], Array]


class WatchedPairs:
    """Fingers, held objects and moving obstacles at the reference, and what their pairs and all others keep."""

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
        """Kept distance of every monitored pair now (p,) [m]; another array, not a changed one, when that changes."""
        return self._live.kept

    @property
    def narrow_pair(self) -> tuple[str, str] | None:
        """The pair that is farthest from keeping what was asked for, since it was too near yet; None: all keep it."""
        return None if self._live.narrow < 0 else self._names.pair(self._live.narrow)

    def set_opening(self, arm: str, least: float, greatest: float) -> tuple[str, str] | None:
        """Say that the gripper of ``arm`` is, and stays, between two openings, 0 closed .. 1 fully open.

        Its fingers count as what they sweep between these, from the next step on; at first, and after :meth:`reset`,
        they are all of their way. Bodies within what they were are always accepted. Others are if every pair keeps its
        distance with them, at the reference and on a certified stop from there. Else nothing changes, and the pair in
        the way is returned. A gripper may be commanded to what was accepted only.

        Raises :class:`RobotError` for a name that is no arm's and for numbers that are no interval.
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
        """Between which openings each arm's gripper counts as being, as :meth:`set_opening` accepted it."""
        return dict(self._fingers.intervals)

    def set_holding(self, arm: str, holds: bool) -> None:
        """Say that the gripper of ``arm`` holds its object from the next step on, or, as after :meth:`reset`, does not.

        The object then is part of the tool. Each of its pairs begins with the distance that there is and keeps more as
        it gets more, until it keeps its own (:attr:`object_distances`). The object is therefore always accepted, and
        nothing moves for it. Raises :class:`RobotError` for an arm that has no object.
        """
        if not self._objects.set_holding(arm, holds):
            return
        self._active.used[0] = 0  # what it names may not count any more
        self._obstacles.hold(self._objects.holding)
        self._observe_again(self._unchanged)
        self._objects.begin()
        self._observe_again(self._unchanged)

    @property
    def holding(self) -> dict[str, bool]:
        """Of each arm that has an object, whether its gripper holds it, as :meth:`set_holding` was told."""
        return {arm: arm in self._objects.holding for arm in self.robot.objects.by_arm}

    @property
    def object_distances(self) -> Array:
        """Kept distance of every pair of ``Robot.objects`` now (pairs,) [m]; minus infinity while it does not count."""
        return self._objects.kept.copy()

    def move_obstacle(self, name: str, obstacle: MovingObstacle | None) -> tuple[str, str] | None:
        """Say where a moving obstacle is from the next step on, and how fast it may move; None: it is gone.

        ``name`` is one of ``ControllerSettings.moving_obstacles``. The arms keep away from all that it can get to
        until they rest, and slow down as it comes nearer. From then on nothing moves closer to it. It counts in any
        case. The pair is returned for which the stop at hand is not proven to end before the obstacle could be there,
        as when it appears in front of a moving arm. Raises :class:`ConfigError` for another name.
        """
        changed = self._obstacles.put(name, obstacle)
        self._active.used[0] = 0  # what it names may not count any more
        blocked = self._observe_again(changed) if self._state.v.any() else -1
        self._certified &= blocked < 0
        self._obstacles.keep_clear(0.0)
        self._observe_again(self._unchanged)
        return None if blocked < 0 else self._names.pair(blocked)

    def pass_time(self, time: float) -> None:
        """Let reports of moving obstacles become older by a ``time`` [s] for which no step is taken.

        Raises :class:`RobotError` for what is no time.
        """
        if not (isinstance(time, float | int) and 0.0 <= time < np.inf):
            raise RobotError(f"time = {shown(time)}: allowed: seconds, 0 or more")
        self._obstacles.pass_time(time)

    @property
    def skew(self) -> float:
        """By how much time one arm may be behind where another one is on the reference [s]; 0: they move as one."""
        return float(self._data_pointer.value.safety.history.window[0])

    def allow_skew(self, time: float) -> None:
        """Let arms be apart in time by up to ``time`` [s], at most 0.1, and stop one by one, from the next step on.

        Bodies of two arms then keep their distance wherever on its own way each arm is: from where the reference had
        it ``time`` ago to the end of the certified stop. More counts as fast as time passes, less counts at once. After
        a :meth:`reset`, all of it does. Raises :class:`RobotError` for what is no such time.
        """
        if not (isinstance(time, float | int) and 0.0 <= time <= LONGEST_WINDOW):
            raise RobotError(f"skew = {shown(time)}: allowed: seconds, 0 to {LONGEST_WINDOW:g}")
        self._data_pointer.value.safety.history.window[1] = time

    def pairs_ahead(self, stop: float) -> PairsAhead:
        """All pairs, for a look at a way before it is gone by arms that stop in ``stop`` [s].

        Held objects count, and moving obstacles where they were reported last.
        """
        kept = self.kept_distances, self._objects.kept, self._obstacles.kept_from(stop)
        return distances_with(self.robot, self.moving_obstacles), np.concatenate(kept)

    @property
    def moving_obstacles(self) -> dict[str, MovingObstacle]:
        """The moving obstacles that are there, by name, as :meth:`move_obstacle` was told last."""
        return dict(self._obstacles.there)

    @property
    def obstacle_reports(self) -> dict[str, ObstacleReport]:
        """The same, and how old these reports are now."""
        return self._obstacles.reports

    def spare_distance(self, arm: str) -> float:
        """How much nearer ``arm`` may come to what is no part of it at the reference [m]; inf if there is no pair.

        Raises as :meth:`tool_pose` does.
        """
        return float(self._spare(self._model_pointer, self._data_pointer, self._with_others[self.robot.arm(arm).name]))

    @property
    def still_obstacles(self) -> Mapping[str, MovingObstacle]:
        """Those of :attr:`moving_obstacles` that stay; another mapping, not a changed one, when that changes."""
        return self._obstacles.still

    @property
    def _kernel_values(self) -> tuple[KernelModel, KernelData, ObstacleData]:
        """All arrays that kernels read and write beside the targets."""
        return self._model_pointer.value, self._data_pointer.value, self._obstacles.data

    def _observe_again(self, grown: IntArray) -> int:
        """Observe what has changed; returns the pair in the way of bodies that have ``grown``, or -1."""
        self._observed, blocked = self._observe_bodies(self._model_pointer, self._data_pointer, grown)
        self._apart = self._observed[-1] >= -ROUNDING
        return int(blocked)
