"""Another controller moves the arms. Elbows may leave the reference, but no arm may come too close to other bodies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot, load_config
from q2r2_control.config.cell import Config
from q2r2_control.config.control import NamedPairDistance, SupervisionSettings
from q2r2_control.config.resources import find_resource
from q2r2_control.config.yaml_text import read_yaml, yaml_of
from q2r2_control.supervision.joint_watch import (
    ExternalArms,
    ExternalSettings,
    settings_for_external_arms,
    watch_settings,
)
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.supervision.supervisor import Phase, Supervisor
from q2r2_control.supervision.target_stream import StreamSettings
from q2r2_control.types import Array, Reference, RobotState
from tests.supervision.conftest import CONFIG, unhurried
from tests.support.reasons import kinds

DT = 0.005  # [s]
SPEED = 0.3  # Speed of the elbow's swing, as the norm of the joint velocities [rad/s].
POST, RADIUS = 2.6, 0.04  # Angle of the swing at which the elbow meets a post [rad], and radius of the post [m].
LAG, PACE = 0.6, 0.3  # Lag of a soft controller [s], and speed of a tool [m/s] or joint [rad/s] that it moves.
MIN_DISTANCE, TOLERANCE = 0.02, 0.01  # [m]


def swing(robot: Robot, angle: float) -> list[Array]:
    """Return postures that begin at home. The left elbow swings inwards by ``angle`` [rad] while no tool moves."""
    data, arm, q = robot.model.createData(), robot.arms["left"], robot.home.copy()
    tool, step = robot.tool_pose(q, "left"), SPEED * DT
    postures, last = [q.copy()], np.eye(7)[2]
    for _ in range(round(angle / step)):
        J = pin.computeFrameJacobian(robot.model, data, q, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)[:, arm.joints]
        free = np.linalg.svd(J)[2][-1]
        last = free if free @ last > 0.0 else -free
        pose = robot.tool_pose(q, "left")
        back = np.r_[tool.translation - pose.translation, pin.log3(tool.rotation @ pose.rotation.T)]
        q[arm.joints] += step * last + np.linalg.pinv(J) @ back
        postures.append(q.copy())
    return postures


@pytest.fixture(scope="module")
def config(robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Config:
    """Return the cell with a post. The measured left elbow meets the post in its swing. The reference stays away."""
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, swing(robot, POST)[-1])
    elbow = data.oMi[robot.model.getJointId("left_A4")].translation
    cell = read_yaml(find_resource(CONFIG).read_text())
    cell["obstacles"]["post"] = {"shape": "sphere", "size": [RADIUS], "position": elbow.tolist()}
    file: Path = tmp_path_factory.mktemp("cell") / "post.yaml"
    file.write_text(yaml_of(cell))
    return settings_for_external_arms(load_config(str(file)))


class World:
    """A supervisor of arms that another controller moves. Its references are not commanded."""

    def __init__(self, config: Config) -> None:
        self.robot = Robot.from_config(config)
        self.controller = CartesianController(self.robot, unhurried(config))
        streams, settings = StreamSettings(), ExternalSettings(tolerance=TOLERANCE)
        watch = watch_settings(config.supervision, yields=False)
        external = ExternalArms(self.robot, self.controller, settings, streams, watch)
        self.supervisor = Supervisor(self.robot, self.controller, streams, watch, external=external)
        self.now = 0.0

    def show(self, postures: list[Array]) -> Reference | None:
        """Show one measured posture after another, one per tick, and return the last reference."""
        zero, reference = np.zeros_like(self.robot.home), None
        for q in postures:
            self.now += DT
            self.supervisor.update_state(RobotState(q, zero, zero, None, self.now), self.now)
            reference = self.supervisor.tick(self.now, DT)
        return reference


@pytest.fixture
def world(config: Config) -> World:
    made = World(config)
    made.show([made.robot.home] * 50)
    assert made.supervisor.phase is Phase.ACTIVE
    made.supervisor.events.clear()
    return made


def test_elbows_may_swing_while_the_tools_rest_but_not_too_close_to_other_bodies(world: World) -> None:
    postures, far = swing(world.robot, 1.5), round(0.7 / (SPEED * DT))
    home = world.controller.tool_pose("left").translation
    # The elbow stays away from the reference for longer than a deviation may last. This alone is no fault.
    world.show(postures[:far] + postures[far : far + 1] * round(1.0 / DT))
    assert np.abs(postures[far] - world.robot.home).max() > 0.5
    assert world.supervisor.phase is Phase.ACTIVE
    assert world.supervisor.events == []
    assert np.linalg.norm(world.controller.tool_pose("left").translation - home) < 1e-3
    world.show(postures[far:] + postures[-1:] * round(0.5 / DT))
    assert world.supervisor.arm_state("left") == "stopped"
    (event,) = world.supervisor.events
    assert event.kind is SupervisionReason.TOO_CLOSE
    assert event.detail["pair"].startswith("left_link_")
    assert event.detail["pair"].endswith("|post_0")
    # The first state that is too close stops the arms, so the distance is too small by one tick's motion at most.
    assert MIN_DISTANCE - TOLERANCE - 1e-3 < event.detail["distance"] <= MIN_DISTANCE - TOLERANCE


def test_the_pair_that_is_farthest_below_its_own_required_distance_is_named(robot: Robot) -> None:
    """Another pair is closer, but it is allowed to be that close."""
    _, pair = sorted(robot.distances(robot.home), key=lambda pair: pair.distance)[:2]
    kept = NamedPairDistance(pair=(pair.name_a, pair.name_b), distance=pair.distance + 0.03)
    controller = CartesianController(robot, ControllerSettings(pairs=(kept,)))
    watch = watch_settings(SupervisionSettings(), yields=False)
    external = ExternalArms(robot, controller, ExternalSettings(tolerance=TOLERANCE), StreamSettings(), watch)
    zero = np.zeros_like(robot.home)
    reason = external.too_close(RobotState(robot.home, zero, zero, None, 0.0))
    assert reason is not None
    assert reason.detail["pair"] == f"{pair.name_a}|{pair.name_b}"
    assert reason.detail["key"] == "pairs[0]"
    assert reason.detail["distance"] == pytest.approx(pair.distance)
    assert reason.detail["allowed"] == pytest.approx(pair.distance + 0.03 - TOLERANCE)


@pytest.mark.parametrize(("joint", "by"), [(0, 0.1), (6, 0.4)], ids=["by a distance", "by an angle alone"])
def test_if_a_tool_stays_away_from_its_reference_the_arm_gets_a_new_reference_at_the_measured_tool(
    world: World, joint: int, by: float
) -> None:
    moved = world.robot.home.copy()
    # The tool is too far from its reference for the start of a stream, but no joint is too far from its reference.
    moved[joint] += by
    steps = [world.robot.home + share * (moved - world.robot.home) for share in np.linspace(0.0, 1.0, 40)]
    world.show(steps + [moved] * round(0.4 / DT))
    assert world.supervisor.events == []
    at_the_tool = world.supervisor.update_target("left", world.robot.tool_pose(moved, "left"), world.now)
    assert kinds(at_the_tool) == "stream_away", "the reference would have to follow a jump"
    world.show([moved] * round(0.4 / DT))
    assert kinds(world.supervisor.events[0]) == "left_behind"
    world.show([moved] * 50)
    assert world.supervisor.phase is Phase.ACTIVE
    tool = world.robot.tool_pose(moved, "left").translation
    assert np.linalg.norm(world.controller.tool_pose("left").translation - tool) < 1e-3


def test_an_arm_may_lag_behind_its_reference_but_an_arm_that_moves_away_from_it_is_stopped(world: World) -> None:
    q, goal, lags = world.robot.home.copy(), world.controller.tool_pose("left"), []

    def lead() -> Reference:
        world.supervisor.update_target("left", goal, world.now)
        reference = world.show([q.copy()])
        assert reference is not None
        return reference

    for _ in range(round(2.0 / DT)):
        goal = pin.SE3(goal.rotation, goal.translation + np.array([0.0, 0.0, PACE * DT]))
        reference = lead()
        lags.append(np.abs(reference.q - q).max())
        q += DT / LAG * (reference.q - q)
    assert world.supervisor.arm_state("left") == "following"
    assert world.supervisor.events == []
    assert min(lags[-round(0.6 / DT) :]) > 0.2  # The lag lasts longer than a deviation may last.
    ran = 0.0
    while not world.supervisor.events:
        q[0] += PACE * DT
        ran += PACE * DT
        lead()
        assert ran < 1.0
    assert kinds(world.supervisor.events[0]) == "off_reference"
    assert world.supervisor.phase is Phase.BRAKING


def test_if_the_targets_of_an_arm_end_during_motion_the_arm_comes_to_rest_without_moving_back(world: World) -> None:
    tool, heights = world.controller.tool_pose("left"), []
    q = world.robot.home.copy()
    for tick in range(round(1.5 / DT)):
        if tick * DT < 0.5:
            goal = pin.SE3(tool.rotation, tool.translation + np.array([0.0, 0.0, PACE * DT * tick]))
            world.supervisor.update_target("left", goal, world.now)
        else:
            world.supervisor.targets.release("left")
        reference = world.show([q])
        assert reference is not None
        q = reference.q  # The other controller follows at once.
        heights.append(world.controller.tool_pose("left").translation[2])
    assert heights[-1] > tool.translation[2] + 0.1
    assert heights[-1] > max(heights) - 1e-4


def test_during_homing_the_tools_move_home_and_targets_are_refused_until_the_tools_arrive(config: Config) -> None:
    world = World(config)
    q = world.robot.home.copy()
    q[[1, 8]] += 0.2
    world.show([q] * 50)
    world.supervisor.events.clear()
    assert world.supervisor.go_home() is None
    while world.supervisor.homing.active:
        assert world.supervisor.update_target("left", world.controller.tool_pose("left"), world.now) is not None
        reference = world.show([q])
        assert reference is not None
        assert world.now < 6.0
        q = reference.q  # The other controller follows at once.
    assert list(map(kinds, world.supervisor.events)) == ["homing_outcome: homing_arrived"]
    assert kinds(world.supervisor.homing.outcome) == "homing_arrived"
    for arm in world.robot.arms:
        home, tool = (world.robot.tool_pose(posture, arm).translation for posture in (world.robot.home, q))
        assert np.linalg.norm(tool - home) < 3e-3
