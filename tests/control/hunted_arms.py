"""Arms that are chased by a moving obstacle called hand. Coal, and not our kernels, measures the distances."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.safety.safety_data import ROUNDING
from q2r2_control.control.solvers.daqp import DaqpSolver
from q2r2_control.robot.kept_distances import kept_by_obstacles
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.verification.fault_injection import FaultySolver, WorstSolver, untimed

RADIUS = 0.1  # Radius of the sphere that represents a hand [m].


@cache
def robot_of_cell() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))


@cache
def controller_and_solver() -> tuple[CartesianController, FaultySolver]:
    robot = robot_of_cell()
    settings = ControllerSettings(moving_obstacles=("hand",))
    solver = FaultySolver(DaqpSolver(robot.model.nv), worst=WorstSolver(robot, np.random.default_rng(0)))
    return CartesianController(robot, settings, solver=untimed(solver, robot.model.nv)), solver


def controller_at_home() -> CartesianController:
    """Return a controller without an obstacle and with a working solver."""
    made, solver = controller_and_solver()
    solver.fault = None
    made.move_obstacle("hand", None)
    made.reset(made.robot.home)
    return made


def hand(at: Array, speed: float = 0.25, **more: Any) -> MovingObstacle:
    return MovingObstacle(shape="sphere", size=(RADIUS,), position=tuple(at.tolist()), speed=speed, **more)


BOX = (0.1, 0.3, 0.2)  # Side lengths of the box that represents a hand [m].


class Coal:
    """Uses the library Coal to measure the distances of all moving bodies from a ball or a box."""

    def __init__(self, controller: CartesianController, shape: coal.CollisionGeometry | None = None) -> None:
        self.model = controller.robot.model
        self.collision_model = controller.robot.collision_model.copy()
        self.collision_model.removeAllCollisionPairs()
        thing = pin.GeometryObject("thing", 0, pin.SE3.Identity(), shape or coal.Sphere(RADIUS))
        number = self.collision_model.addGeometryObject(thing)
        bodies = [i for i in range(number) if self.collision_model.geometryObjects[i].parentJoint]
        for body in bodies:
            self.collision_model.addCollisionPair(pin.CollisionPair(body, number))
        joints = [self.collision_model.geometryObjects[body].parentJoint for body in bodies]
        self.moved_by = np.zeros((len(bodies), self.model.nv), dtype=bool)  # The joints that move each body.
        for row, joint in enumerate(joints):
            self.moved_by[row, [self.model.joints[i].idx_v for i in list(self.model.supports[joint])[1:]]] = True
        self.kept = kept_by_obstacles(controller.robot, controller.settings).values
        self._data, self._geometry = self.model.createData(), self.collision_model.createData()

    def distances(self, q: Array, at: Array) -> Array:
        """Return the distances (bodies,) [m] at the posture ``q`` (nv,), with the ball or box ``at`` (3,) [m]."""
        return np.array([result.min_distance for result in self._results(q, at)])

    def towards_nearest(self, q: Array, at: Array) -> Array:
        """Return the unit vector (3,) from the ball to the nearest body."""
        results = self._results(q, at)
        nearest = results[int(np.argmin([result.min_distance for result in results]))]
        way = np.asarray(nearest.getNearestPoint1()) - at
        return np.asarray(way / np.linalg.norm(way))

    def _results(self, q: Array, at: Array) -> Any:
        self.collision_model.geometryObjects[-1].placement = pin.SE3(np.eye(3), at)
        pin.computeDistances(self.model, self._data, self.collision_model, self._geometry, q)
        return self._geometry.distanceResults


class Hunt:
    """A moving obstacle (sphere or box) that chases the nearest body at full speed, and moves at random in between.

    Each body that moves is checked in the middle and at the end of every tick. The body must keep its distance from the
    obstacle, or must not approach the reported position of the obstacle. All other pairs must keep their distances too.
    The solver returns deliberately bad solutions.
    """

    def __init__(
        self, controller: CartesianController, solver: FaultySolver, seed: int, lie: float = 1.0, box: bool = False
    ) -> None:
        """Make a sphere, or a ``box``, whose true speed is ``lie`` times the reported speed."""
        shape = coal.Box(*BOX) if box else coal.Sphere(RADIUS)
        self.controller, self.solver, self.coal, self.box = controller, solver, Coal(controller, shape), box
        self.random, self.lie = np.random.default_rng(seed), lie
        robot = controller.robot
        seen: Any = SimpleNamespace(model=robot.model, collision_model=self.coal.collision_model)
        solver.worst = WorstSolver(seen, self.random)
        solver.kept = self.coal.kept
        self.at = robot.tool_pose(robot.home, "left").translation + np.array([0.0, 0.9, 0.0])
        self.velocity, self.way = np.zeros(3), np.zeros(3)
        self.broken: list[float] = []  # Missing distance between a moving body and the hand in each violation [m].
        self.nearest_moving, self.touched, self.moved, self.retreats = np.inf, 0, 0, 0

    def run(self, seconds: float, speed: float, period: float, acceleration: float | None = None) -> None:
        """Run the hunt. The controller gets a report on the obstacle every ``period`` [s]."""
        controller, robot = self.controller, self.controller.robot
        targets = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
        q, v, t, due, change = robot.home, np.zeros(robot.model.nv), 0.0, 0.0, 0.0
        while t < seconds:
            dt = float(self.random.choice([0.001, 0.004, 0.0015, 0.01, 0.03], p=[0.5, 0.2, 0.2, 0.08, 0.02]))
            if t >= change:
                change = t + self.random.uniform(0.2, 0.9)
                self.way = np.zeros(3) if self.random.random() < 0.6 else self.random.normal(size=3)
                self.solver.fault = str(self.random.choice(["towards_nearest", "no_rows", "corner"], p=[0.7, 0.2, 0.1]))
            if t >= due:
                due = t + period
                now = None if acceleration is None else min(float(np.linalg.norm(self.velocity)), speed)
                known = hand(self.at, speed, acceleration=acceleration, speed_now=now)
                box = {"shape": "box", "size": BOX} if self.box else {}
                controller.move_obstacle("hand", known.model_copy(update=box))
                reported = self.at
            places = self._move(q, dt, speed * self.lie, acceleration)
            self.solver.q = q
            reference = controller.step(targets, dt)
            middle = q + 0.5 * dt * (0.75 * v + 0.25 * reference.v)
            postures = (middle, reference.q) if dt <= controller.settings.max_substep else (reference.q,)
            self._check(q, reported, postures, places[-len(postures) :])
            assert (robot.distance_values(reference.q) >= controller.kept_distances - ROUNDING).all()
            q, v, t = reference.q, reference.v, t + dt

    def _move(self, q: Array, dt: float, speed: float, acceleration: float | None) -> tuple[Array, Array]:
        """Move the hand in one tick. Return its position (3,) [m] in the middle and at the end of the tick."""
        way = self.way if self.way.any() else self.coal.towards_nearest(q, self.at)
        wanted = speed * way / np.linalg.norm(way)
        change = wanted - self.velocity
        most = np.inf if acceleration is None else acceleration * dt
        before = self.velocity
        self.velocity = before + change * min(1.0, most / max(float(np.linalg.norm(change)), 1e-12))
        start = self.at
        if acceleration is None:
            before = self.velocity
        halfway = start + 0.5 * dt * (0.75 * before + 0.25 * self.velocity)
        self.at = start + 0.5 * dt * (before + self.velocity)
        return halfway, self.at

    def _check(self, q: Array, reported: Array, postures: tuple[Array, ...], places: tuple[Array, ...]) -> None:
        before = self.coal.distances(q, reported)
        for posture, place in zip(postures, places, strict=True):
            moves = (self.coal.moved_by & (posture != q)).any(axis=1)
            margin = self.coal.distances(posture, place) - self.coal.kept
            self.touched += int(margin.min() < 0.0)
            self.moved += int(moves.any())
            if not moves.any():
                continue
            closer = self.coal.distances(posture, reported) < before - ROUNDING
            self.nearest_moving = min(self.nearest_moving, float(margin[moves].min()))
            self.retreats += int((moves & (margin < 0.0) & ~closer).any())
            wrong = moves & closer & (margin < -ROUNDING)
            self.broken += (-margin[wrong]).tolist()
