"""Findings of q2r2 ros doctor about KUKA drivers, and their cures."""

from __future__ import annotations

import importlib.util
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config
from q2r2_control.plants.fri.wire import CommandKind, Session
from q2r2_control.ros.watching.findings import Finding, examine_environment
from q2r2_control.ros.watching.set_view import DriverView, NodeView, SetView
from tests.ros.conftest import need_ros, spun_node
from tests.ros.processes import Processes, wait_until

need_ros()

from lbr_fri_idl.msg import LBRJointPositionCommand, LBRState
from std_msgs.msg import String

from q2r2_control.ros.base_node import LATCHED_QOS
from q2r2_control.ros.watching.lbr_drivers import DriverListener, examine_drivers
from tests.ros.test_set_listener import COMMAND, LONG
from tests.ros.virtual_lbrs import lbr_cell

STATE, COMMAND_TYPE = "lbr_fri_idl/msg/LBRState", "lbr_fri_idl/msg/LBRJointPositionCommand"
# Limits of an iiwa 7 [deg], [deg/s].
ENDS, SPEEDS = (170, 120, 170, 120, 170, 120, 175), (98, 98, 100, 130, 140, 180, 180)


def urdf(ends: float = 1.0, speed_of_a1: float = 1.0, prefix: str = "lbr_A") -> str:
    """Return a URDF whose limits are these multiples of the model's."""
    parts = ['<link name="link_0"/>']
    for number, (end, speed) in enumerate(zip(ENDS, SPEEDS, strict=True), start=1):
        limit, fastest = math.radians(ends * end), math.radians((speed_of_a1 if number == 1 else 1.0) * speed)
        parts.append(
            f'<link name="link_{number}"/><joint name="{prefix}{number}" type="revolute">'
            f'<parent link="link_{number - 1}"/><child link="link_{number}"/><axis xyz="0 0 1"/>'
            f'<limit lower="{-limit}" upper="{limit}" velocity="{fastest}" effort="200"/></joint>'
        )
    return f'<robot name="lbr">{"".join(parts)}</robot>'


@pytest.fixture
def cell(tmp_path: Path) -> Config:
    return load_config(lbr_cell(tmp_path))


def driver(arm: str = "left", **changes: Any) -> DriverView:
    states = {f"/{arm}/lbr_state": {STATE}, f"/{arm}/state": set[str]()}
    state = LBRState(session_state=int(Session.COMMANDING_ACTIVE), client_command_mode=int(CommandKind.POSITION))
    command = f"/{arm}/command/lbr_joint_position_command"
    return replace(DriverView(arm, command, states, {COMMAND_TYPE}, state, urdf()), **changes)


def found(cell: Config, *drivers: DriverView, nodes: tuple[NodeView, ...] = ()) -> list[Finding]:
    return examine_drivers(SetView(nodes, (), (), (), drivers), cell)


def test_the_doctor_finds_no_fault_in_drivers_that_lbr_fri_ros2_stack_starts(cell: Config) -> None:
    assert found(cell, driver(), driver("right", description=urdf(169 / 170))) == []
    assert found(cell) == []


WAITS = LBRState(session_state=int(Session.COMMANDING_WAIT), connection_quality=3, drive_state=2)
EVERY_5_MS = LBRState(session_state=int(Session.COMMANDING_ACTIVE), client_command_mode=1, sample_time=0.005)
TORQUE = LBRState(session_state=int(Session.COMMANDING_ACTIVE), client_command_mode=int(CommandKind.TORQUE))
LAUNCH = "ros2 launch lbr_bringup hardware.launch.py robot_name:=left ctrl:=lbr_joint_position_command_controller"
CASES = {
    "no state topic": ({"states": {"/left/lbr_state": set(), "/left/state": set()}}, "nobody publishes", LAUNCH),
    "another type": (
        {"states": {"/left/lbr_state": {"std_msgs/msg/String"}}},
        f"/left/lbr_state is std_msgs/msg/String, the driver's is {STATE}",
        "ctrl_prefix begin with its namespace",
    ),
    "silent": ({"state": None}, "no message came on /left/lbr_state and /left/state", "launch file anew"),
    "no taker of commands": (
        {"takers": set()},
        f"/left/command/lbr_joint_position_command has no taker; needed: {COMMAND_TYPE}",
        "ros2 control load_controller --set-state active lbr_joint_position_command_controller -c /left/controller_man",
    ),
    "a session that waits": ({"state": WAITS}, "the cabinet is in commanding wait, connection excellent", "pendant"),
    "torques": ({"state": TORQUE}, "the Sunrise application asks for torque commands", "pendant"),
    "narrower positions": (
        {"description": urdf(0.94)},
        "left_A7 is commanded -169.0 to 169.0 deg; its driver shuts the connection beyond -164.5 to 164.5 deg",
        "control.position_margin: 0.184",
    ),
    "narrower positions, less a step of safe_stop": (
        {"description": urdf(0.96), "state": EVERY_5_MS},
        "left_A7 is commanded -169.0 to 169.0 deg; its driver shuts the connection beyond -167.1 to 167.1 deg",
        "control.position_margin: 0.138",
    ),
    "narrower velocities": (
        {"description": urdf(speed_of_a1=0.8)},
        "left_A1 is commanded up to 83.3 deg/s; its driver shuts the connection beyond 78.4 deg/s",
        "control.velocity_scale: 0.800",
    ),
    "other joints": (
        {"description": urdf(prefix="right_A")},
        "/left/robot_description has no joints for left_A1, left_A2",
        "ctrl_prefix name the driver of this arm",
    ),
    "no URDF": ({"description": "<robot"}, "/left/robot_description", "start the driver anew"),
}


@pytest.mark.parametrize(("changes", "what", "cure"), CASES.values(), ids=CASES)
def test_every_fault_that_keeps_a_driver_from_following_is_found_with_its_cure(
    changes: dict[str, Any], what: str, cure: str, cell: Config
) -> None:
    (finding,) = found(cell, driver(**changes))
    assert finding.stops_arms
    assert what in finding.what
    assert cure in finding.cure


def test_limits_that_cannot_be_compared_cause_a_warning(cell: Config) -> None:
    (finding,) = found(cell, driver(description=""))
    assert not finding.stops_arms
    assert "its limits are not compared" in finding.what


def test_the_doctor_does_not_judge_a_drivers_session_if_a_controller_runs(cell: Config) -> None:
    controller = NodeView("/controller", "error", "waits", 0.1, {"phase": "inactive"})
    assert found(cell, driver(state=WAITS), nodes=(controller,)) == []


def test_missing_message_packages_are_found_with_the_command_that_builds_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "lbr_fri_idl" else find(name))
    _, findings = examine_environment({"ROS_DOMAIN_ID": "-1"})  # In this domain, no node can start.
    (finding,) = (one for one in findings if "lbr_fri_idl" in one.what)
    assert (finding.stops_arms, finding.cure) == (True, "q2r2 ros build-interfaces")


def test_the_doctor_listens_to_a_driver_but_not_to_commands(node: Any, domain: int, cell: Config) -> None:
    state = node.create_publisher(LBRState, "/left/state", 10)
    node.create_publisher(String, "/left/robot_description", LATCHED_QOS).publish(String(data="<robot/>"))
    node.create_subscription(LBRJointPositionCommand, "/left/command/joint_position", lambda message: None, 1)
    with spun_node(domain, "listener") as own:
        listener = DriverListener(own, cell)
        left, right = listener.views

        def heard() -> bool:
            listener.look()
            state.publish(LBRState(session_state=3))
            return left.state is not None and bool(left.description and left.takers)

        wait_until(heard, "the driver is heard", lambda: left)
        assert (left.states["/left/state"], left.takers) == ({STATE}, {COMMAND_TYPE})
        assert (right.state, right.description, right.takers) == (None, "", set())
        assert node.count_subscribers("/left/command/lbr_joint_position_command") == 0


@pytest.mark.slow
def test_the_doctor_names_a_driver_that_does_not_run(processes: Processes, tmp_path: Path) -> None:
    doctor = processes.start(*COMMAND, "doctor", lbr_cell(tmp_path), "--duration", "1", name="doctor")
    assert doctor.wait(LONG) == 1
    assert "the left arm: nobody publishes /left/lbr_state and /left/state" in doctor.output
    assert LAUNCH in doctor.output
