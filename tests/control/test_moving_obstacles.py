"""Obstacles that move on their own: arms rest before they can be touched, and are usable beside them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.kernel_model import kernel_model_of
from q2r2_control.control.qp import DaqpSolver
from q2r2_control.control.safety.safety_data import ROUNDING
from q2r2_control.errors import ConfigError
from q2r2_control.robot.kept_distances import kept_by_obstacles
from q2r2_control.robot.obstacle_bodies import with_obstacle_bodies
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, StepStatus
from q2r2_control.verification.fault_injection import FaultySolver, WorstSolver
from tests.support.object_cell import BLOCK, cell

RADIUS = 0.1  # of a hand [m]


@cache
def robot_of_cell() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))


@cache
def controller_and_solver() -> tuple[CartesianController, FaultySolver]:
    robot = robot_of_cell()
    settings = ControllerSettings(moving_obstacles=("hand",))
    solver = FaultySolver(DaqpSolver(robot.model.nv), worst=WorstSolver(robot, np.random.default_rng(0)))
    return CartesianController(robot, settings, solver=solver), solver


@pytest.fixture
def controller() -> Iterator[CartesianController]:
    """At home, without an obstacle."""
    made, solver = controller_and_solver()
    solver.fault = None
    made.move_obstacle("hand", None)
    made.reset(made.robot.home)
    yield made
    made.move_obstacle("hand", None)


def hand(at: Array, speed: float = 0.25, **more: Any) -> MovingObstacle:
    return MovingObstacle(shape="sphere", size=(RADIUS,), position=tuple(at.tolist()), speed=speed, **more)


BOX = (0.1, 0.3, 0.2)  # sides [m]


class Coal:
    """Distances of all bodies that move from a ball or a box, by Coal."""

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
        self.moved_by = np.zeros((len(bodies), self.model.nv), dtype=bool)  # joints of each body
        for row, joint in enumerate(joints):
            self.moved_by[row, [self.model.joints[i].idx_v for i in list(self.model.supports[joint])[1:]]] = True
        self.kept = kept_by_obstacles(controller.robot, controller.settings).values
        self._data, self._geometry = self.model.createData(), self.collision_model.createData()

    def distances(self, q: Array, at: Array) -> Array:
        """(bodies,) [m]."""
        return np.array([result.min_distance for result in self._results(q, at)])

    def towards_nearest(self, q: Array, at: Array) -> Array:
        """Unit vector (3,) from the ball to the nearest body."""
        results = self._results(q, at)
        nearest = results[int(np.argmin([result.min_distance for result in results]))]
        way = np.asarray(nearest.getNearestPoint1()) - at
        return np.asarray(way / np.linalg.norm(way))

    def _results(self, q: Array, at: Array) -> Any:
        self.collision_model.geometryObjects[-1].placement = pin.SE3(np.eye(3), at)
        pin.computeDistances(self.model, self._data, self.collision_model, self._geometry, q)
        return self._geometry.distanceResults


class Hunt:
    """A hand that goes after the nearest body at its full speed, for a while, and then anywhere for another.

    At every tick and in its middle: a body that moves is as far from it as it has to be, or comes no closer to where
    it was reported. A solver works against the arms; other pairs and joints keep their promises too.
    """

    def __init__(
        self, controller: CartesianController, solver: FaultySolver, seed: int, lie: float = 1.0, box: bool = False
    ) -> None:
        """``lie``: how many times faster the hand, or a ``box``, is than it says."""
        shape = coal.Box(*BOX) if box else coal.Sphere(RADIUS)
        self.controller, self.solver, self.coal, self.box = controller, solver, Coal(controller, shape), box
        self.random, self.lie = np.random.default_rng(seed), lie
        robot = controller.robot
        seen: Any = SimpleNamespace(model=robot.model, collision_model=self.coal.collision_model)
        solver.worst = WorstSolver(seen, self.random)
        solver.kept = self.coal.kept
        self.at = robot.tool_pose(robot.home, "left").translation + np.array([0.0, 0.9, 0.0])
        self.velocity, self.way = np.zeros(3), np.zeros(3)
        self.broken: list[float] = []  # by how much a body that moved was too near [m]
        self.nearest_moving, self.touched, self.moved, self.retreats = np.inf, 0, 0, 0

    def run(self, seconds: float, speed: float, period: float, acceleration: float | None = None) -> None:
        """Reports come every ``period`` [s]."""
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
        """The hand after half of a tick and after all of it."""
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


@pytest.mark.parametrize(
    ("speed", "period", "acceleration", "box"),
    [
        pytest.param(0.25, 0.033, None, False, id="a slow hand, reported often"),
        pytest.param(1.6, 0.033, None, False, id="a person who walks"),
        pytest.param(0.5, 0.3, None, True, id="a box that is reported too seldom"),
        pytest.param(1.0, 0.033, 3.0, False, id="with a bound on its acceleration"),
    ],
)
def test_no_body_that_moves_comes_near_a_hand_that_hunts_it(
    controller: CartesianController, speed: float, period: float, acceleration: float | None, box: bool
) -> None:
    hunt = Hunt(controller, controller_and_solver()[1], seed=1, box=box)
    hunt.run(6.0, speed, period, acceleration)
    assert not hunt.broken
    assert hunt.touched > 50, "it gets to arms that rest"
    assert hunt.moved > 500, "and arms move whenever they may"


def test_a_hand_that_is_faster_than_it_says_gets_to_an_arm_that_moves(controller: CartesianController) -> None:
    hunt = Hunt(controller, controller_and_solver()[1], seed=1, lie=5.0)
    hunt.run(6.0, 0.25, 0.1)
    assert hunt.broken, "or the test above could not fail"


def circle(t: float, start: dict[str, pin.SE3], radius: float = 0.05, turns: float = 0.8) -> dict[str, pin.SE3]:
    angle = 2.0 * np.pi * turns * t
    by = radius * np.array([np.sin(angle), 0.0, 1.0 - np.cos(angle)])
    return {arm: pin.SE3(pose.rotation, pose.translation + by) for arm, pose in start.items()}


def worst_error(controller: CartesianController, obstacle: MovingObstacle | None, seconds: float = 3.0) -> float:
    """Of the left tool on a circle that both hands lead [m], after the first second."""
    start, worst = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}, 0.0
    for tick in range(round(seconds / 0.002)):
        if obstacle is not None and tick % 16 == 0:
            controller.move_obstacle("hand", obstacle)
        targets = circle(0.002 * tick, start)
        report = controller.step(targets, 0.002).report
        if tick > 500:
            away = controller.tool_pose("left").translation - targets["left"].translation
            worst = max(worst, float(np.linalg.norm(away)))
            assert report.status is StepStatus.OK
            assert report.certified
            assert not report.fallback
    return worst


def test_arms_follow_as_in_free_air_beside_a_slow_hand(controller: CartesianController) -> None:
    free = worst_error(controller, None)
    controller.reset(controller.robot.home)
    side = controller.tool_pose("left").translation + np.array([0.0, 0.3 + RADIUS + 0.06, 0.0])
    beside = worst_error(controller, hand(side))
    assert Coal(controller).distances(controller.robot.home, side).min() == pytest.approx(0.3, abs=0.05)
    assert beside < 1.5 * free + 1e-3


def test_reports_that_cease_bring_arms_to_rest_and_the_report_names_the_pair(controller: CartesianController) -> None:
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    far = start["left"].translation + np.array([0.0, 0.8, 0.0])
    controller.move_obstacle("hand", hand(far))
    references = [controller.step(circle(0.002 * tick, start), 0.002) for tick in range(3000)]
    assert np.abs(references[500].v).max() > 0.05
    assert np.abs(references[-1].v).max() < 1e-3
    assert references[-1].report.margin < 0.0
    assert "hand_0" in references[-1].report.tightest_pair
    controller.move_obstacle("hand", hand(far))
    assert max(np.abs(controller.step(circle(0.002 * tick, start), 0.002).v).max() for tick in range(500)) > 0.05


def test_an_obstacle_in_front_of_a_moving_arm_is_named_and_the_arm_brakes_along_its_stop(
    controller: CartesianController,
) -> None:
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    forward = {"left": pin.SE3(start["left"].rotation, start["left"].translation + np.array([0.2, 0.0, 0.1]))}
    for _ in range(150):
        reference = controller.step(forward, 0.002)
    assert controller.move_obstacle("hand", hand(start["left"].translation + np.array([0.0, 0.9, 0.0]))) is None
    tool = controller.tool_pose("left").translation
    ahead = tool + np.array([RADIUS + 0.06, 0.0, 0.02])
    pair = controller.move_obstacle("hand", hand(ahead))
    assert pair is not None
    assert "hand_0" in pair
    longest = float((np.abs(reference.v) / controller.stop_deceleration).max())
    for _ in range(int(longest / 0.002) + 2):
        reference = controller.step(forward, 0.002)
        assert not reference.report.certified
    coal_distances = Coal(controller)
    before = coal_distances.distances(reference.q, ahead).min()
    for tick in range(300):
        if tick % 10 == 0:
            controller.move_obstacle("hand", hand(ahead))
        now = coal_distances.distances(controller.step(forward, 0.002).q, ahead).min()
        assert now >= before - 1e-9, "nothing moves towards it any more"
        before = now


def test_a_box_that_is_put_down_is_an_obstacle_like_any_and_gone_when_taken_away(
    controller: CartesianController,
) -> None:
    start = controller.tool_pose("left")
    place, goal = start.translation + np.array([0.0, 0.2, 0.0]), start.translation + np.array([0.0, 0.2, 0.0])
    box = MovingObstacle(shape="box", size=(0.1, 0.1, 0.4), position=tuple(place.tolist()), speed=0.0)
    assert controller.move_obstacle("hand", box) is None
    references = [controller.step({"left": pin.SE3(start.rotation, goal)}, 0.002) for _ in range(1500)]
    assert all(reference.report.certified for reference in references)
    assert np.abs(references[-1].v).max() < 5e-3
    buffer = controller.settings.distance_buffer
    assert references[-1].report.margin == pytest.approx(buffer, abs=1e-3)
    assert "hand_0" in references[-1].report.tightest_pair
    controller.move_obstacle("hand", None)
    assert controller.moving_obstacles == {}
    for _ in range(1500):
        controller.step({"left": pin.SE3(start.rotation, goal)}, 0.002)
    assert np.linalg.norm(controller.tool_pose("left").translation - goal) < 2e-3


def test_arms_beside_a_hand_that_comes_too_near_may_leave_it_and_the_other_arm_moves(
    controller: CartesianController,
) -> None:
    start = {arm: controller.tool_pose(arm) for arm in controller.robot.arms}
    near = start["left"].translation + np.array([0.0, RADIUS + 0.08, 0.0])
    controller.move_obstacle("hand", hand(near))
    for _ in range(250):
        controller.move_obstacle("hand", hand(near))
        controller.step({}, 0.002)
    assert np.linalg.norm(controller.tool_pose("left").translation - start["left"].translation) < 1e-3, "not pushed"
    towards = {"left": pin.SE3(start["left"].rotation, near), "right": circle(0.3, start)["right"]}
    for _ in range(500):
        controller.move_obstacle("hand", hand(near))
        controller.step(towards, 0.002)
    assert np.linalg.norm(controller.tool_pose("right").translation - towards["right"].translation) < 5e-3
    assert np.linalg.norm(controller.tool_pose("left").translation - start["left"].translation) < 5e-3
    away = {"left": pin.SE3(start["left"].rotation, start["left"].translation - np.array([0.0, 0.1, 0.0]))}
    for _ in range(1500):
        controller.move_obstacle("hand", hand(near))
        controller.step(away, 0.002)
    assert np.linalg.norm(controller.tool_pose("left").translation - away["left"].translation) < 5e-3


def least_ahead(controller: CartesianController) -> float:
    distances, kept = controller.pairs_ahead(0.05)
    return float((distances(controller.step({}, 0.0).q) - kept).min())


def test_a_look_ahead_finds_what_arms_beside_a_hand_keep_while_they_are_slow(controller: CartesianController) -> None:
    side = controller.tool_pose("left").translation + np.array([0.0, RADIUS + 0.12, 0.0])
    controller.move_obstacle("hand", hand(side))
    for _ in range(250):
        controller.move_obstacle("hand", hand(side))
        reference = controller.step({}, 0.002)
    assert "hand_0" in reference.report.tightest_pair
    assert least_ahead(controller) == pytest.approx(reference.report.margin, abs=1e-6)
    controller.move_obstacle("hand", None)
    distances, kept = controller.pairs_ahead(0.05)
    np.testing.assert_array_equal(kept, controller.kept_distances)
    np.testing.assert_allclose(distances(reference.q), controller.robot.distance_values(reference.q), atol=2e-6)


def test_a_held_box_keeps_away_too_once_it_is_held() -> None:
    config = cell(BLOCK)
    robot = Robot.from_config(config)
    settings = config.control.model_copy(update={"moving_obstacles": ("hand",)})
    geometry, plain = with_obstacle_bodies(robot, ("hand",)), with_obstacle_bodies(robot, ())
    assert plain is robot.objects.geometry
    hull = [item for item in geometry.geometryObjects if "hull" in item.name]
    assert [item.name for item in hull] == ["left_object_hull"]
    half = 0.5 * np.array(BLOCK["box"])
    across = np.sqrt((half**2).sum() - half.max() ** 2)
    assert hull[0].geometry.radius >= across - 1e-6
    controller = CartesianController(robot, settings)
    below = controller.tool_pose("left").act(np.array([0.0, 0.0, 0.05 + RADIUS]))
    controller.move_obstacle("hand", hand(below, speed=0.0))
    before = controller.step({}, 0.002).report
    least = [least_ahead(controller)]
    controller.set_holding("left", True)
    after = controller.step({}, 0.002).report
    least.append(least_ahead(controller))
    assert least == pytest.approx([before.margin, after.margin], abs=1e-6)
    assert after.margin < before.margin
    assert "left_object_hull" in after.tightest_pair


def test_the_reach_of_an_obstacle_is_that_of_a_point_that_gains_speed() -> None:
    made = hand(np.zeros(3), 1.0, acceleration=2.0, speed_now=0.2)
    assert (made.slower, made.rise) == pytest.approx((0.8, 0.4))
    assert hand(np.zeros(3), 1.0, acceleration=2.0).slower == 0.0
    assert hand(np.zeros(3), 1.0, speed_now=0.2).slower == 0.0


def test_without_names_no_array_of_the_kernels_has_another_size() -> None:
    robot = robot_of_cell()
    without, one = (
        kernel_model_of(robot, ControllerSettings(moving_obstacles=names)).safety for names in ((), ("hand",))
    )
    assert len(without.min_distance) == len(robot.collision_model.collisionPairs)
    bodies = sum(item.parentJoint > 0 for item in robot.collision_model.geometryObjects)
    assert len(one.min_distance) == len(without.min_distance) + bodies
    np.testing.assert_array_equal(one.min_distance[: len(without.min_distance)], without.min_distance)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        pytest.param({"shape": "cone", "size": (0.1,), "speed": 0.1}, "shape", id="a shape that is none"),
        pytest.param({"shape": "sphere", "size": (0.1,)}, "speed: missing", id="no speed"),
        pytest.param({"shape": "box", "size": (0.1,), "speed": 0.1}, "size", id="a box with one side"),
        pytest.param({"shape": "sphere", "size": (0.1,), "speed": float("inf")}, "speed", id="any speed"),
        pytest.param({"shape": "sphere", "size": (0.1,), "speed": 0.1, "speed_now": 0.2}, "speed_now", id="too fast"),
    ],
)
def test_what_is_no_obstacle_is_refused_in_one_line(values: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        MovingObstacle(**values)


def test_a_name_that_the_settings_do_not_have_is_refused(controller: CartesianController) -> None:
    with pytest.raises(ConfigError, match="'foot': allowed: hand"):
        controller.move_obstacle("foot", hand(np.zeros(3)))
    with pytest.raises(ConfigError, match="table"):
        CartesianController(controller.robot, ControllerSettings(moving_obstacles=("table",)))
