"""The moving obstacles of one controller: their last reports, and the distances that pairs with them keep."""

from __future__ import annotations

from functools import partial

import numpy as np
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.config.moving_obstacle import MovingObstacle, ObstacleReport, check_obstacle
from q2r2_control.control.geometry.collision import CollisionBodies, bodies_of
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.jit import bound
from q2r2_control.control.kernel_model import KernelModel, stop_buffer
from q2r2_control.control.kernel_pointers import KernelPointer, pointer_to
from q2r2_control.control.safety.protective_distance import REPORT_AGE, ObstacleData, keep_clear, keep_while_stopping
from q2r2_control.robot.kept_distances import kept_by_obstacles
from q2r2_control.robot.obstacle_bodies import HULL, body_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


class MovingObstacles:
    """The obstacles that are present, by name. For pairs with absent obstacles, the kept distance is minus infinity."""

    def __init__(
        self,
        robot: Robot,
        settings: ControllerSettings,
        pointers: tuple[KernelPointer, ...],
        geometry: pin.GeometryModel,
    ) -> None:
        """Take the pointers to the kernels' model and data, which have the bodies and pairs of ``geometry``."""
        model: KernelModel = pointers[0].value
        self._robot, self._bodies, limits = robot, model.safety.collision.bodies, model.safety.limits
        names, last = [item.name for item in geometry.geometryObjects], len(geometry.collisionPairs)
        self._number = {name: names.index(f"{name}_0") for name in settings.moving_obstacles}
        count, goal = len(self._number), kept_by_obstacles(robot, settings).values
        hulls = {f"{held.link}{HULL}": arm for arm, held in robot.objects.by_arm.items()}
        pairs = list(geometry.collisionPairs)[last - len(goal) :]
        # For each pair, the arm that has to hold the pair's object so that the pair counts; None for other pairs.
        self._holders = [hulls.get(names[pair.first]) for pair in pairs]
        self._limits = limits
        self.data = ObstacleData(
            first=(len(goal) // max(count, 1)) * np.arange(count + 1),
            speed=np.zeros(count),
            slower=np.zeros(count),
            rise=np.ones(count),
            age=np.zeros(count),
            kept=np.full(len(goal), -np.inf),
            buffer=np.zeros(len(goal)),
            velocity=limits.velocity.copy(),
            stop_time=np.zeros(1),
        )
        self.there: dict[str, MovingObstacle] = {}
        self.still: dict[str, MovingObstacle] = {}  # The obstacles whose speed is 0. Each report makes a new mapping.
        self._holding: frozenset[str] = frozenset()
        if count:
            pointers = *pointers, pointer_to(self.data)
            self._keep_while_stopping = partial(bound(keep_while_stopping, *pointers), *pointers)
            self._keep_clear = partial(bound(keep_clear, *pointers, 0.0), *pointers)
        self.change(settings)

    @property
    def reports(self) -> dict[str, ObstacleReport]:
        """The last reports of the obstacles that are present."""
        ages = zip(self._number, self.data.age.tolist(), strict=True)
        return {name: ObstacleReport(self.there[name], age) for name, age in ages if name in self.there}

    def put(self, name: str, obstacle: MovingObstacle | None) -> IntArray:
        """Take a report of an obstacle, or None if it has gone. Returns an array (g,): 1 for the body that has changed.

        Until :meth:`keep_clear` is called, all pairs with obstacles keep the distances that they need while the arms
        stop. Raises the same exceptions as :func:`check_obstacle`.
        """
        check_obstacle(name, obstacle, self._number)
        number, index = self._number[name], list(self._number).index(name)
        changed: IntArray = np.zeros(len(self._bodies.joint), dtype=np.int64)
        if obstacle is None:
            self.there.pop(name, None)
        else:
            self.there[name] = obstacle
            changed[number] = 1
            write_body(self._bodies, number, obstacle)
            data = self.data
            data.speed[index], data.slower[index], data.rise[index] = obstacle.speed, obstacle.slower, obstacle.rise
            data.age[index] = obstacle.age
        self.still = {name: one for name, one in self.there.items() if one.speed == 0.0}
        self._count()
        return changed

    def hold(self, holding: frozenset[str]) -> None:
        """Store that the grippers of exactly these arms hold their objects."""
        self._holding = holding
        self._count()

    def change(self, settings: ControllerSettings) -> None:
        """Let pairs keep the distances of ``settings``."""
        self._goal = kept_by_obstacles(self._robot, settings).values
        self.data.buffer[:] = stop_buffer(self._goal, settings)
        self._count()

    def kept_from(self, stop: float) -> Array:
        """Return the distances (n,) [m] that pairs keep from the reported poses, if the arms stop in ``stop`` [s].

        Only pairs with obstacles that are present are included.
        """
        kept = self.data.kept.reshape(len(self._number), -1) if self._number else np.zeros((0, 0))
        way = self.data.speed * (np.maximum(self.data.age, REPORT_AGE) + stop)
        return np.ravel((kept + way[:, None])[[name in self.there for name in self._number]])

    def keep_clear(self, h: float) -> None:
        """Write kept distances and velocity limits for the kernels, before a step of ``h`` [s]."""
        if self.there:
            self._keep_clear(h)

    def pass_time(self, time: float) -> None:
        """Let reports age by ``time`` [s] in which no step is taken."""
        self.data.age[:] += time

    def _count(self) -> None:
        """Choose the pairs that keep a distance: those whose obstacle is present.

        A pair of an obstacle with an object keeps its distance only while a gripper holds the object.
        """
        if not self._number:
            return
        there = np.repeat([name in self.there for name in self._number], len(self._goal) // len(self._number))
        held = np.array([arm is None or arm in self._holding for arm in self._holders])
        self.data.kept[:] = np.where(there & held, self._goal, -np.inf)
        self._keep_while_stopping()
        if not self.there:
            self._limits.velocity[:] = self.data.velocity
            self.data.stop_time[:] = (self.data.velocity / self._limits.acceleration).max()


def write_body(bodies: CollisionBodies, number: int, obstacle: MovingObstacle) -> None:
    """Write an obstacle as the body ``number`` of a collision model."""
    body = pin.GeometryModel()
    body.addGeometryObject(body_of("", obstacle))
    for array, value in zip(bodies, bodies_of(body), strict=True):
        array[number] = value[0]
