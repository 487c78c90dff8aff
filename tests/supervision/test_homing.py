"""Homing moves all joints home from any posture and keeps the contract. It can be interrupted."""

from __future__ import annotations

from itertools import chain, repeat
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import coal
import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, Robot, load_config
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.events import CommonReason, Reason
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.ros.reasons import RosReason
from q2r2_control.supervision.homing import JointHoming, ToolHoming
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.supervision.supervisor import Supervisor
from q2r2_control.supervision.target_stream import StreamSettings
from q2r2_control.types import Array, Reference, RobotState
from q2r2_control.verification.contract import Contract
from q2r2_control.wording import sentence
from tests.control.test_moving_obstacles import Coal
from tests.supervision.conftest import CONFIG, STRICT, unhurried
from tests.support.reasons import kinds

DT = 0.004  # [s]
LONGEST = 60.0  # Longest time that homing may take [s].


class World:
    """A supervisor whose arms are at its references. The contract is checked at every tick."""

    def __init__(self, robot: Robot, controller: CartesianController, q: Array) -> None:
        self.controller = controller
        self.supervisor = Supervisor(robot, controller, StreamSettings(), STRICT)
        self.state = RobotState(q.copy(), np.zeros_like(q), np.zeros_like(q), None, 0.0)
        self.supervisor.activate(self.state, 0.0)
        self.contract = Contract(controller, q)
        self.now = 0.0
        self.fastest = 0.0  # Speed of the fastest joint [rad/s].

    def tick(self) -> Reference:
        self.now += DT
        self.supervisor.update_state(self.state, self.now)
        reference = self.supervisor.tick(self.now, DT)
        assert reference is not None
        self.contract.check(reference, DT)
        assert reference.report.certified
        assert reference.report.margin > -1e-9
        self.fastest = max(self.fastest, float(np.abs(reference.v).max()))
        self.state = RobotState(reference.q, reference.v, self.state.tau, None, self.now)
        return reference

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / DT)):
            self.tick()

    def go_home(self) -> str:
        """Go home, and return the result."""
        assert self.supervisor.go_home() is None
        while self.now < LONGEST and self.supervisor.homing.active:
            self.tick()
        ended = [event for event in self.supervisor.events if event.kind is SupervisionReason.HOMING_OUTCOME]
        return kinds(ended[0].cause) if ended else "it goes on"


def postures(robot: Robot, controller: CartesianController, count: int, seed: int) -> list[Array]:
    """Return random postures with a certified stop and a margin of 5 mm for every pair."""
    random = np.random.default_rng(seed)
    found: list[Array] = []
    while len(found) < count:
        q = random.uniform(robot.position_lower + 0.1, robot.position_upper - 0.1)
        controller.reset(q)
        report = controller.step({}, DT).report
        if report.certified and report.margin > 0.005:
            found.append(q)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("reached", "count"), [(6, 6), pytest.param(48, 50, marks=pytest.mark.soak)])
def test_from_nearly_all_random_postures_all_joints_reach_home_and_keep_the_contract(
    robot: Robot, controller: CartesianController, reached: int, count: int
) -> None:
    ends = []
    for q in postures(robot, controller, count, seed=0):
        world = World(robot, controller, q)
        ends.append(world.go_home())
        if ends[-1] == "homing_arrived":
            assert np.abs(world.state.q - robot.home).max() < 0.004
        assert world.fastest < 0.45
    assert ends.count("homing_arrived") >= reached, ends


def test_a_motion_is_braked_before_homing_begins(robot: Robot, controller: CartesianController) -> None:
    world = World(robot, controller, robot.home)
    tool = controller.tool_pose("left")
    for step in range(100):
        raised = tool.copy()
        raised.translation += np.array([0.0, 0.0, 0.3 * DT * step])
        world.supervisor.update_target("left", raised, world.now)
        world.tick()
    assert world.fastest > 0.3
    assert world.go_home() == "homing_arrived"
    world.run(1.0)
    assert np.abs(world.state.q - robot.home).max() < 0.01
    assert np.abs(world.state.v).max() < 1e-3


@pytest.mark.parametrize(
    ("how", "arguments"), [("pause", (True,)), ("stop", (Reason(RosReason.STOP_SERVICE),)), ("reset", ())]
)
def test_homing_can_be_interrupted_and_the_arms_then_come_to_rest_at_once(
    robot: Robot, controller: CartesianController, how: str, arguments: tuple[object, ...]
) -> None:
    (q,) = postures(robot, controller, 1, seed=6)
    world = World(robot, controller, q)
    assert world.supervisor.go_home() is None
    world.run(3.0)
    at = world.state.q
    assert np.abs(world.state.v).max() > 0.1
    getattr(world.supervisor, how)(*arguments)
    for _ in range(round(1.5 / DT)):
        if how == "stop" and np.abs(world.state.v).max() < 1e-4:
            break
        world.tick()
    assert not world.supervisor.homing.active
    assert np.abs(world.state.v).max() < 1e-2
    assert np.abs(world.state.q - at).max() < 0.04


def test_if_the_caller_ends_homing_early_the_outcome_is_that_homing_was_interrupted(
    robot: Robot, controller: CartesianController
) -> None:
    world = World(robot, controller, robot.home + 0.05)
    homing = world.supervisor.homing
    assert world.supervisor.go_home() is None
    world.run(0.1)
    assert homing.hold() is None
    assert not homing.active
    assert kinds(homing.outcome) == "homing_interrupted"


def test_while_no_path_home_is_known_the_arms_rest_and_a_tick_examines_at_most_two_postures(robot: Robot) -> None:
    distances = Mock(side_effect=chain([np.ones(3)], repeat(np.zeros(3))))  # Only the start is free of collisions.
    bounds = {"position_lower": robot.position_lower, "position_upper": robot.position_upper}
    searched: Any = SimpleNamespace(arms=robot.arms, **bounds)
    homing, q, ticks = JointHoming(searched, lambda: (distances, np.full(3, 0.02)), robot.home), robot.home + 0.5, 0
    while homing.outcome is None:
        before = distances.call_count
        at = homing.step(q, np.zeros_like(q), DT).joints
        assert at is not None
        assert np.array_equal(at, q)
        assert distances.call_count - before <= 3  # One call measures the start, and two calls examine postures.
        ticks += 1
    assert homing.outcome is CommonReason.HOMING_NO_WAY
    assert ticks > 100


def test_homing_ends_if_only_the_straight_path_is_allowed_and_this_path_is_not_free(robot: Robot) -> None:
    free = Mock(side_effect=chain([np.ones(3)], repeat(np.zeros(3))))
    bounds = {"position_lower": robot.position_lower, "position_upper": robot.position_upper}
    searched: Any = SimpleNamespace(arms=robot.arms, **bounds)
    homing = JointHoming(searched, lambda: (free, np.full(3, 0.02)), robot.home, straight=True)
    for _ in range(2):
        homing.step(robot.home + 0.5, np.zeros_like(robot.home), DT)
    assert homing.outcome is CommonReason.HOMING_NO_WAY


def test_if_an_arm_cannot_move_homing_waits_for_it_and_then_ends_with_the_reason_homing_held_up(
    robot: Robot,
) -> None:
    settings = load_config(CONFIG).control
    homing = JointHoming(robot, lambda: (robot.distance_values, kept_distances(robot, settings).values), robot.home)
    q = robot.home.copy()
    q[0] += 0.8
    farthest = 0.0
    for _ in range(round(10.0 / DT)):
        at = homing.step(q, np.zeros_like(q), DT).joints  # The reference does not move.
        assert at is not None
        farthest = max(farthest, float(np.abs(at - q).max()))
        if homing.outcome is not None:
            break
    assert homing.outcome is CommonReason.HOMING_HELD_UP
    assert 0.05 < farthest < 0.13  # A farther target would let the arm start fast when it is free again.


@pytest.mark.parametrize(
    "away",
    [
        pytest.param(pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.2])), id="0.2 m away, at 0.1 m/s"),
        pytest.param(pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.6])), np.zeros(3)), id="0.6 rad away, at 0.3 rad/s"),
    ],
)
def test_if_the_tools_do_not_reach_home_homing_ends_five_seconds_after_they_were_due_at_home(
    robot: Robot, away: pin.SE3
) -> None:
    home = robot.tool_pose(robot.home, "left")
    homing, zero, outcomes = ToolHoming({"left": home}, lambda _arm: home * away), np.zeros_like(robot.home), []
    for dt in (1.9, 0.2, 4.8, 0.2):  # The target needs 2 s to move home.
        target = homing.step(robot.home, zero, dt).targets["left"]
        assert target is not None
        outcomes.append((target.isApprox(home, 1e-9), homing.outcome))
    assert outcomes == [(False, None), (True, None), (True, None), (True, CommonReason.HOMING_HELD_UP)]


def test_the_fastest_joint_goes_home_at_0_3_rad_per_second(robot: Robot) -> None:
    homing = JointHoming(robot, lambda: (lambda q: np.ones(3), np.full(3, 0.02)), robot.home)
    q, speeds = robot.home + 0.1, []
    q[2] += 0.3
    while homing.outcome is None:
        at = homing.step(q, np.zeros_like(q), DT).joints
        assert at is not None
        speeds.append(np.abs(at - q).max() / DT)
        q = at.copy()  # The arms follow at once.
    assert homing.outcome is CommonReason.HOMING_ARRIVED
    assert max(speeds) == pytest.approx(0.3)
    assert sum(speeds) * DT == pytest.approx(0.4)


class Beside(World):
    """A world with an obstacle that is reported 30 times a second from ``begin`` [s] on.

    At each tick it asserts that no link comes too close to the obstacle.
    """

    def __init__(self, controller: CartesianController, q: Array, thing: MovingObstacle, begin: float = 0.0) -> None:
        super().__init__(controller.robot, controller, q)
        self.thing, self.begin, self.due = thing, begin, begin
        shape = coal.Box(*thing.size) if thing.shape == "box" else coal.Sphere(*thing.size)
        self.coal = Coal(controller, shape)

    def tick(self) -> Reference:
        if self.now >= self.due:
            self.due = self.now + 0.033
            assert self.controller.move_obstacle("thing", self.thing) is None
        reference = super().tick()
        if self.now > self.begin:
            self.check(reference.q)
        return reference

    def check(self, q: Array) -> None:
        assert (self.coal.distances(q, np.array(self.thing.position)) >= self.coal.kept - 1e-9).all()


@pytest.fixture
def in_the_way(robot: Robot) -> tuple[CartesianController, Array, Array]:
    """Return a controller, a posture with the left arm turned outwards, and a point on this arm's straight path home.

    The point is where the left tool is halfway home (3,), in the world frame [m].
    """
    settings = unhurried(load_config(CONFIG)).model_copy(update={"moving_obstacles": ("thing",)})
    turned = robot.home.copy()
    turned[robot.arms["left"].joints[0]] += 1.0
    middle = robot.tool_pose(0.5 * (turned + robot.home), "left").translation
    return CartesianController(robot, settings), turned, middle


@pytest.mark.parametrize(
    "thing",
    [
        pytest.param({"shape": "box", "size": (0.1, 0.1, 0.3), "speed": 0.0}, id="a box that somebody put down"),
        pytest.param({"shape": "sphere", "size": (0.1,), "speed": 0.25}, id="a hand that may move"),
    ],
)
def test_a_path_home_avoids_a_moving_obstacle_at_the_position_that_was_reported(
    in_the_way: tuple[CartesianController, Array, Array], thing: dict[str, Any]
) -> None:
    controller, turned, middle = in_the_way
    world = Beside(controller, turned, MovingObstacle(position=tuple(middle.tolist()), **thing))
    with pytest.raises(AssertionError):
        world.check(0.5 * (turned + controller.robot.home))  # The straight path is not free.
    assert world.go_home() == "homing_arrived"
    assert np.abs(world.state.q - controller.robot.home).max() < 0.004


def test_if_a_moving_obstacle_enters_the_path_home_the_arms_wait_until_homing_ends(
    in_the_way: tuple[CartesianController, Array, Array],
) -> None:
    controller, turned, middle = in_the_way
    box = MovingObstacle(shape="box", size=(0.1, 0.1, 0.3), position=tuple(middle.tolist()), speed=0.0)
    world = Beside(controller, turned, box, begin=0.5)
    assert world.go_home() == "homing_held_up"
    assert world.supervisor.homing.outcome is not None
    assert "thing" in sentence(world.supervisor.homing.outcome)
    assert np.abs(world.state.v).max() < 0.02
    assert np.abs(world.state.q - turned).max() > 0.1
