"""Two arms behind lbr_fri_ros2_stack, as its releases name things: sessions that begin and end, and its guards."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from q2r2_control import Robot
from q2r2_control.config.cell import load_config, parse_config
from q2r2_control.config.resources import find_resource
from q2r2_control.robot.compose import WORLD
from q2r2_control.ros.bridge.messages import called_otherwise
from q2r2_control.supervision.supervisor import Phase
from q2r2_control.types import SIDES, Array, CommandMode
from tests.ros.cell import PATIENT, RATE, start_controller
from tests.ros.conftest import need_ros
from tests.ros.processes import CONFIG, Processes, States

need_ros()

from geometry_msgs.msg import PoseStamped
from lbr_fri_idl.msg import LBRJointPositionCommand, LBRState
from sensor_msgs.msg import JointState

from q2r2_control.ros.base_node import COMMAND_QOS, BaseNode
from q2r2_control.ros.bridge.lbr_driver import LbrDrivers
from q2r2_control.ros.bridge.messages import stamped_pose
from q2r2_control.ros.launch.processes import nodes_of
from tests.ros.fake_lbr import PERIOD, TAU, TOPICS, FakeLbr
from tests.ros.lbr_delay import measure
from tests.ros.lbr_soak import LbrSoak
from tests.ros.test_intakes import Arrivals
from tests.ros.virtual_lbrs import Operator, lbr_cell, virtual_lbrs


class PublishedLbr(FakeLbr):
    """The same behind topics, by a timer."""

    def __init__(self, node: Any, robot: Robot, arm: str, release: str) -> None:
        super().__init__(robot, arm)
        command, state = TOPICS[release]
        node.create_subscription(LBRJointPositionCommand, f"/{arm}/command/{command}", self.take, 1)
        self._states = node.create_publisher(LBRState, f"/{arm}/{state}", 10)
        self._joints = node.create_publisher(JointState, f"/{arm}/joint_states", 10)
        self._timer = node.create_timer(PERIOD, self._tick)

    def _tick(self) -> None:
        self.advance()
        self._states.publish(self.state())
        self._joints.publish(self.joint_state())


@pytest.mark.alone
@pytest.mark.parametrize("release", TOPICS)
def test_both_arms_move_in_commanding_active_only_and_trip_no_guard_of_their_driver(
    release: str, node: Any, processes: Processes, robot: Robot, tmp_path: Path
) -> None:
    drivers = {arm: PublishedLbr(node, robot, arm, release) for arm in SIDES}
    publishers = {arm: node.create_publisher(PoseStamped, f"/q2r2/{arm}/target_frame", COMMAND_QOS) for arm in SIDES}
    states = States(node, "cartesian_controller")
    cell = lbr_cell(tmp_path)
    given = [
        f"{name}:={value}" for name, value in nodes_of(cell)[0].parameters.items() if name not in ("config", "rate")
    ]
    controller = start_controller(processes, *PATIENT, *given, config=cell)

    def tool(arm: str) -> pin.SE3:
        return robot.tool_pose(np.concatenate([drivers[side].q for side in SIDES]), arm)

    def move(by: tuple[float, float, float], duration: float, longest: float = math.inf, turn: float = 0.0) -> None:
        """Both hands, as streams that begin at the tools; ``turn`` about the tool's axis [rad]."""
        starts, began = {arm: tool(arm) for arm in SIDES}, time.monotonic()
        while (passed := time.monotonic() - began) < min(duration + 1.0, longest):
            share = min(passed / duration, 1.0)
            for arm, start in starts.items():
                turned = start.rotation @ pin.exp3(np.array([0.0, 0.0, share * turn]))
                goal = pin.SE3(turned, start.translation + share * np.array(by))
                publishers[arm].publish(stamped_pose(goal, WORLD, 0.0))
            time.sleep(1.0 / RATE)

    states.wait_for(phase="inactive", kind="fri_session")
    controller.wait_for("left_A1 is lbr_A1")
    drivers["left"].begin()
    states.wait_for(phase="inactive", kind="fri_session")
    drivers["right"].begin()
    states.wait_for(phase="active")
    before = {arm: tool(arm).translation for arm in SIDES}
    move((0.0, 0.0, 0.05), 1.0)
    for arm in SIDES:
        assert_allclose(tool(arm).translation - before[arm], (0.0, 0.0, 0.05), atol=3e-3)
    move((0.0, 0.1, 0.0), 1.0, longest=0.5)
    drivers["left"].drop()
    states.wait_for(phase="inactive", kind="fri_session")
    stopped = drivers["right"].q.copy()
    move((0.1, 0.0, 0.0), 0.3)
    assert_allclose(drivers["right"].q, stopped, atol=0.02, err_msg="it brakes, and follows no target")
    drivers["left"].begin()
    states.wait_for(phase="active")
    before = {arm: tool(arm).translation for arm in SIDES}
    move((0.0, 0.0, -0.05), 1.0)
    for arm in SIDES:
        assert_allclose(tool(arm).translation - before[arm], (0.0, 0.0, -0.05), atol=3e-3)
    move((2.0, 0.5, 0.5), 2.0)  # far out of reach
    move((0.0, 0.0, 0.0), 4.0, turn=1.9 * math.pi)  # to the end of the last joint
    farthest = [abs(driver.q[6]) for driver in drivers.values()]
    assert max(farthest) > math.radians(165.0)
    # Commands that are late on a busy machine make a driver fast: the soak judges velocities, in a time of its own.
    assert [trip for driver in drivers.values() for trip in driver.trips if not trip.startswith("velocity")] == []


@pytest.mark.parametrize("sessions", [15, pytest.param(500, marks=pytest.mark.soak)])
@pytest.mark.parametrize("release", TOPICS)
def test_sessions_that_end_in_every_way_there_is_trip_no_guard_and_jump_nowhere(
    release: str, sessions: int, domain: int
) -> None:
    with virtual_lbrs(release, seed=sessions, domain=domain) as virtual:
        soak = LbrSoak(virtual, sessions).run()
    assert soak.faults == []
    assert soak.activations > 0.4 * sessions
    assert soak.moved > 1.0


def test_a_session_that_begins_while_the_arms_still_brake_gets_no_command_of_the_stop(domain: int) -> None:
    with virtual_lbrs("for Jazzy", domain=domain) as virtual:
        Operator(virtual)
        left, supervisor = virtual.drivers["left"], virtual.node._supervisor
        for driver in virtual.drivers.values():
            driver.begin()
        virtual.run(lambda: np.abs(left.v).max() > 0.3 or virtual.now > 30.0)
        left.drop()
        virtual.run(lambda: supervisor.phase is Phase.BRAKING or virtual.now > 30.0)
        left.begin()
        virtual.run(lambda: supervisor.phase is Phase.INACTIVE or virtual.now > 30.0)
        assert left.target is None
        virtual.run(lambda: left.target is not None or virtual.now > 30.0)
        assert (supervisor.phase, left.trips) == (Phase.ACTIVE, [])


def test_the_drivers_filter_delays_by_its_time_constant_and_bears_commands_that_come_unevenly(robot: Robot) -> None:
    with_it, without = measure(robot, TAU), measure(robot, 0.0)
    assert with_it.delay == pytest.approx(TAU, abs=0.5 * PERIOD)
    assert without == pytest.approx((0.0, 2.0), abs=1e-9)
    assert 1.1 < with_it.uneven_speed < 1.0 / 0.85  # as far as presets lbr_* stay from the velocity limits
    assert measure(robot, 0.02).uneven_speed < 1.0 / 0.8


def test_external_torques_are_told_once_both_drivers_have_and_none_that_are_no_numbers(
    context: Any, robot: Robot
) -> None:
    node, told = BaseNode("controller", context=context), list[Array]()
    LbrDrivers(node, robot, {arm: f"/{arm}" for arm in SIDES}, CommandMode.POSITION, told.append)
    for arm, torque in (("left", 1.0), ("right", 2.0), ("right", math.nan), ("left", 3.0)):
        Arrivals(node, f"/{arm}/lbr_state").arrive(LBRState(external_torque=np.full(7, torque)))
    assert len(told) == 2
    for arm, torque in (("left", 3.0), ("right", 2.0)):
        np.testing.assert_array_equal(told[-1][robot.arms[arm].joints], torque)
    node.destroy_node()


@pytest.mark.parametrize(
    ("given", "theirs"),
    [
        (("lbr_A2", "lbr_A1", "gripper"), ["lbr_A1", "lbr_A2"]),
        (("A1", "A2"), ["A1", "A2"]),
        (("left_lbr_A1", "left_lbr_A2"), ["left_lbr_A1", "left_lbr_A2"]),
        (("one_A1", "two_A1", "one_A2", "two_A2"), []),
        (("lbr_A1",), []),
        (("right_A1", "right_A2"), []),
        (("right_lbr_A1", "right_lbr_A2"), []),
        (("left_joint_2", "left_joint_1", "finger_1"), ["left_joint_1", "left_joint_2"]),
        (("joint_1", "joint_2", "finger_joint_1", "finger_joint_2"), []),
        (("joint_1", "joint_2", "joint_3"), []),
        (("right_joint_1", "right_joint_2"), []),
    ],
)
def test_names_are_told_apart_by_their_last_part_where_that_tells_one_of_this_arm(
    given: tuple[str, ...], theirs: list[str]
) -> None:
    ours = ("left_A1", "left_A2")
    assert called_otherwise(ours, given, ("right",)) == dict(zip(ours, theirs, strict=False))


def test_a_cell_of_their_driver_keeps_its_limits_unless_told_otherwise(tmp_path: Path) -> None:
    text = find_resource("config/dual_iiwa7_fri.yaml").read_text()
    assert load_config(CONFIG).control.position_margin == 0.01
    assert parse_config(text, "cell.yaml").control.position_margin == 0.105
    model = text.replace("limits: driver", "limits: model")
    assert parse_config(model, "cell.yaml").control.position_margin == 0.01
    file = lbr_cell(tmp_path)
    control = load_config(file).control
    assert (control.position_margin, control.velocity_scale) == (0.105, 0.85)
    changed = Path(file).read_text().replace("limits: driver", "limits: model")
    assert parse_config(changed, "cell.yaml").control.velocity_scale == 1.0
