"""Two arms behind lbr_fri_ros2_stack, with the topics of each release: sessions begin and end, and no guard trips."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from q2r2_control import Robot
from q2r2_control.config.cell_file import load_config, parse_config
from q2r2_control.config.resources import find_resource
from q2r2_control.drives.base import make_drive
from q2r2_control.errors import ConfigError
from q2r2_control.ros.bridge.messages import called_otherwise
from q2r2_control.supervision.supervisor import Phase
from q2r2_control.types import SIDES, Array, CommandMode
from tests.ros.conftest import need_ros
from tests.ros.processes import CONFIG

need_ros()

from lbr_fri_idl.msg import LBRJointPositionCommand, LBRState

from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.joint_outputs import Channel, JointOutput, LbrPosition
from q2r2_control.ros.bridge.lbr_driver import LbrDrivers
from q2r2_control.ros.monitoring import WatchedPublisher
from tests.ros.fake_lbr import NARROWER, PERIOD, TOPICS, FakeLbr
from tests.ros.lbr_soak import LbrSoak
from tests.ros.test_intakes import Arrivals
from tests.ros.virtual_lbrs import Operator, lbr_cell, virtual_lbrs

PAGE = Path(__file__).parents[2] / "docs/kuka.md"
# The rows of the table of filters in docs/kuka.md.
FILTERS = re.findall(r"^\| (0[.\d]*) \| ([.\d]+) \| ([.\d]+) \|$", PAGE.read_text(), re.MULTILINE)


@pytest.mark.parametrize("sessions", [15, pytest.param(500, marks=pytest.mark.soak)])
@pytest.mark.parametrize("release", TOPICS)
def test_no_guard_trips_and_no_command_jumps_however_the_sessions_end(release: str, sessions: int, domain: int) -> None:
    with virtual_lbrs(release, domain, sessions) as virtual:
        soak = LbrSoak(virtual, sessions).run()
    assert soak.faults == []
    assert soak.activations > 0.4 * sessions
    assert soak.moved > 1.0


def test_a_session_that_begins_while_the_arms_still_brake_gets_no_command_of_the_stop(domain: int) -> None:
    with virtual_lbrs("for Jazzy", domain) as virtual:
        Operator(virtual)
        left, supervisor = virtual.drivers["left"], virtual.node._supervisor
        for driver in virtual.drivers.values():
            driver.begin()
        virtual.run(lambda: np.abs(left.v).max() > 0.3 or virtual.now > 30.0)
        left.drop()
        virtual.run(lambda: supervisor.phase is Phase.BRAKING or virtual.now > 30.0)
        assert virtual.node.health()[2]["kind"] == "fri_session"
        left.begin()
        virtual.run(lambda: supervisor.phase is Phase.INACTIVE or virtual.now > 30.0)
        assert left.target is None
        virtual.run(lambda: left.target is not None or virtual.now > 30.0)
        assert (supervisor.phase, left.trips) == (Phase.ACTIVE, [])


@pytest.mark.parametrize(("tau", "delay", "speed"), [tuple(map(float, row)) for row in FILTERS])
def test_the_delay_of_the_drivers_filter_and_its_speed_after_a_double_step_agree_with_docs_kuka(
    tau: float, delay: float, speed: float, robot: Robot
) -> None:
    driver, ramp = FakeLbr(robot, "left", tau), 0.2  # ``ramp`` is the speed of the commanded joints [rad/s].
    driver.begin()
    for tick in range(200):
        driver.take(
            LBRJointPositionCommand(joint_position=robot.home[robot.arms["left"].joints] + tick * PERIOD * ramp)
        )
        driver.advance()
    assert driver.target is not None
    assert 1e3 * (driver.target - driver.q) / ramp == pytest.approx(delay, abs=0.05)
    driver.take(LBRJointPositionCommand(joint_position=driver.target + 2.0 * PERIOD * ramp))
    driver.advance()
    assert driver.v / ramp == pytest.approx(speed, abs=0.005)


def test_external_torques_are_used_only_if_they_are_finite_and_both_drivers_have_sent_them(
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


def test_an_arm_is_ready_only_after_its_driver_reports_commanding_active(domain: int) -> None:
    with virtual_lbrs("for Jazzy", domain) as virtual:
        Operator(virtual)
        supervisor, left, right = virtual.node._supervisor, virtual.drivers["left"], virtual.drivers["right"]
        # The left driver has no state broadcaster.
        virtual.change = lambda topic, message: None if topic == "/left/lbr_state" else message
        for driver in virtual.drivers.values():
            driver.begin()
        virtual.run(lambda: supervisor.phase is Phase.ACTIVE or virtual.now > 5.0)
        _, line, values = virtual.node.health()
        assert (values["kind"], supervisor.phase) == ("fri_silent", Phase.INACTIVE)
        assert "left: no FRI message from its driver on /left/lbr_state or /left/state; " in line
        assert "load_controller --set-state active lbr_state_broadcaster -c /left/controller_manager" in line
        assert (left.target, right.target) == (None, None)
        left.drop()
        virtual.change = lambda topic, message: message
        virtual.run(lambda: supervisor.phase is Phase.ACTIVE or virtual.now > 10.0)
        assert (virtual.node.health()[2]["kind"], supervisor.phase) == ("fri_session", Phase.INACTIVE)
        left.begin()
        virtual.run(lambda: left.target is not None or virtual.now > 15.0)
        assert (supervisor.phase, left.trips) == (Phase.ACTIVE, [])


@pytest.mark.parametrize("topics", [("/left/joints", "/right/command/joints"), ("/lbr/command/a", "/lbr/command/b")])
def test_command_topics_without_a_namespace_for_each_driver_are_refused(
    topics: tuple[str, str], context: Any, robot: Robot
) -> None:
    node = BaseNode("controller", context=context)
    channels = [
        Channel([], np.sort(robot.arms[arm].joints), WatchedPublisher(node, LBRJointPositionCommand, topic, 0.5))
        for arm, topic in zip(SIDES, topics, strict=True)
    ]
    output = JointOutput(
        make_drive(CommandMode.POSITION, robot, load_config(CONFIG)), LbrPosition(0.005, robot), channels
    )
    with pytest.raises(ConfigError, match=r"allowed: <namespace>/command/<name>, with a namespace for each arm"):
        output.driver_namespaces(robot)
    node.destroy_node()


@pytest.mark.parametrize("release", TOPICS)
def test_the_release_of_a_driver_is_recognised_by_its_topics_and_reported_once(
    release: str, context: Any, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, told, (_, name) = BaseNode("controller", context=context), list[str](), TOPICS[release]
    monkeypatch.setattr(node.get_logger(), "info", told.append)
    LbrDrivers(node, robot, {"left": "/left"}, CommandMode.POSITION, lambda torques: None)
    for _ in range(2):
        Arrivals(node, f"/left/{name}").arrive(LBRState())
    assert told == [f"/left/{name}: the driver of the left arm, with the topics of releases {release}"]
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
def test_a_joint_name_is_recognised_by_its_last_part_if_this_part_identifies_one_joint_of_the_arm(
    given: tuple[str, ...], theirs: list[str]
) -> None:
    ours = ("left_A1", "left_A2")
    assert called_otherwise(ours, given, ("right",)) == dict(zip(ours, theirs, strict=False))


def test_a_cell_behind_this_driver_has_the_drivers_limits_unless_its_yaml_says_limits_model(tmp_path: Path) -> None:
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


def test_the_position_margin_covers_the_drivers_soft_limits_and_the_step_of_its_safe_stop(
    robot: Robot, tmp_path: Path
) -> None:
    margin, longest_period = load_config(lbr_cell(tmp_path)).control.position_margin, 0.01
    assert margin >= NARROWER + math.radians(5.0)
    assert margin >= NARROWER + float(robot.velocity_limit.max()) * longest_period
