"""Faults of a set of nodes or its environment, and their cures."""

from __future__ import annotations

import ast
import re
from dataclasses import replace
from typing import Any

import pytest

from q2r2_control import load_config
from q2r2_control.events import Reason
from q2r2_control.ros.reasons import RosReason
from q2r2_control.ros.watching.findings import PACKAGES, Finding, examine_environment, examine_set
from q2r2_control.ros.watching.set_view import NodeView, SetView, TopicView, arm_views
from q2r2_control.wording import sentence
from tests.ros.processes import CONFIG, ROOT

CELL = load_config(CONFIG)
EXPECTED = ("mujoco_robot", "cartesian_controller", "left_arm_controller", "right_arm_controller")


def node(name: str, **values: Any) -> NodeView:
    return NodeView(name, values.pop("level", "ok"), values.pop("message", "fine"), values.pop("age", 0.1), values)


def topic(name: str, publishers: tuple[str, ...], subscribers: tuple[str, ...], *types: str) -> TopicView:
    return TopicView(name, types or ("some/msg/Type",), publishers, subscribers, None)


def arm(name: str, **values: Any) -> NodeView:
    given = {"arm": name, "hand": name, "state": "idle", "ready": True, "engaged": False}
    return node(f"/{name}_arm", **(given | {"sent": {f"/{name}/target": 1}} | values))


CONTROLLER = node("/controller", phase="active", left_state="holding", right_state="holding", sent={"/commands": 1})
ROBOT = node("/robot", refused_commands=0)
LEFT, RIGHT = arm("left"), arm("right")
HAND = node("/hand", sent={"/q2r_left_hand_pose": 5})
TOPICS = (
    topic("/left/target", ("/left_arm",), ("/controller",)),
    topic("/right/target", ("/right_arm",), ("/controller",)),
    topic("/commands", ("/controller",), ("/robot",)),
    topic("/joint_states", ("/robot",), ("/controller",)),
    topic("/q2r_left_hand_pose", ("/hand",), ("/left_arm",)),
    topic("/tf", ("/robot", "/rsp"), ("/left_arm", "/right_arm")),
)


def view(*changed: NodeView | TopicView, without: str = "", **fields: Any) -> SetView:
    parts: dict[str, Any] = {one.name: one for one in (CONTROLLER, ROBOT, LEFT, RIGHT, HAND, *TOPICS)}
    parts |= {one.name: one for one in changed}
    parts.pop(without, None)
    nodes = tuple(one for one in parts.values() if isinstance(one, NodeView))
    topics = tuple(one for one in parts.values() if isinstance(one, TopicView))
    return replace(SetView(nodes, topics, tuple(one.name for one in nodes), arm_views(nodes, CELL)), **fields)


def found(seen: SetView) -> list[Finding]:
    return examine_set(seen, EXPECTED)


def test_the_doctor_finds_nothing_if_a_set_has_no_faults_or_if_no_set_runs() -> None:
    assert found(view()) == []
    assert found(SetView((), (), ("/stranger",), arm_views((), CELL))) == []


OTHER = node("/other", phase="active", left_state="holding")
STOPPED = "/c is stopped: by hand; call /c/reset"
NO_CLOCK = Reason(RosReason.NO_CLOCK)
NO_SUBSCRIBER = "/left/target has no subscriber"
STOPPING = {
    "two publishers of a target": (
        view(topic("/left/target", ("/left_arm", "/x"), ("/controller",))),
        *("2 publishers of /left/target: /left_arm, /x", "end all but one"),
    ),
    "two commanders": (view(topic("/positions", ("/x",), ("/robot",))), "/robot is commanded by several", "end"),
    "two controllers": (
        view(OTHER, topic("/left/target", ("/left_arm",), ("/controller", "/other"))),
        *("two controllers take /left/target: /controller, /other", "end all but one"),
    ),
    "one node twice": (view(names=("/robot", "/robot")), "2 nodes are called /robot", "end"),
    "no arm": (view(without="/left_arm"), "the left arm: no node", "start left_arm_controller"),
    "no controller": (view(without="/controller"), "no built-in controller", "start cartesian"),
    "no robot": (view(without="/joint_states"), "nothing publishes joint states", "start the"),
    "silent": (view(node("/robot", age=5.0)), "/robot is silent for 5 s", "restart it"),
    "no clock": (
        view(arm("left", clock_problem=NO_CLOCK.as_json())),
        f"/left_arm: {sentence(NO_CLOCK)}",
        "without use_sim_time",
    ),
    "an arm that is not ready": (
        view(arm("left", ready=False, message=NO_SUBSCRIBER, kind="no_subscriber")),
        *(f"the left arm: {NO_SUBSCRIBER}", "start the arm's controller"),
    ),
    "a fault of the controller": (
        view(node("/controller", phase="inactive", level="error", message="silent", kind="states_silent")),
        *("/controller: silent", "look at the robot's driver"),
    ),
    "stop": (
        view(arm("left", ready=False, message=STOPPED, kind="controller_refuses")),
        *("/c is stopped", "/c/reset"),
    ),
}


@pytest.mark.parametrize(("seen", "what", "cure"), STOPPING.values(), ids=STOPPING)
def test_every_fault_that_stops_the_arms_is_found_with_its_cure(seen: SetView, what: str, cure: str) -> None:
    assert [one for one in found(seen) if one.stops_arms and what in one.what and cure in one.cure], found(seen)


def test_two_controllers_that_move_one_arm_each_may_share_a_command_topic() -> None:
    left = node("/controller", phase="active", left_state="holding", sent={"/commands": 1})
    right = node("/other", phase="active", right_state="holding", sent={"/commands": 1})
    assert found(view(left, right, topic("/commands", ("/controller", "/other"), ("/robot",)))) == []


def test_a_second_receiver_of_commands_causes_a_warning() -> None:
    (finding,) = found(view(topic("/commands", ("/controller",), ("/robot", "/echo"))))
    assert "2 takers: /robot, /echo" in finding.what
    assert not finding.stops_arms


ROS = ROOT / "q2r2_control" / "ros"

INTERFACES = {file.parent.name for file in ROS.glob("interfaces/*/package.xml")}


def test_every_package_that_the_nodes_import_is_checked() -> None:
    imported = {
        name.split(".")[0]
        for file in ROS.rglob("*.py")
        for part in ast.walk(ast.parse(file.read_text()))
        for name in ([part.module or ""] if isinstance(part, ast.ImportFrom) else [])
    }
    ros = {name for name in imported if re.fullmatch(r"rclpy|.*_(msgs|srvs|interfaces)", name)}
    assert ros - INTERFACES == set(PACKAGES)


@pytest.mark.parametrize(
    ("variables", "reaches"),
    [
        ({}, "SUBNET"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_STATIC_PEERS": "10.0.0.2"}, "OFF, and 10.0.0.2"),
        ({"ROS_LOCALHOST_ONLY": "1"}, "this machine only"),
    ],
)
def test_the_report_says_which_computers_nodes_can_find(variables: dict[str, str], reaches: str) -> None:
    facts, findings = examine_environment(variables | {"ROS_DOMAIN_ID": "-1"})  # In this domain, no node can start.
    assert facts["reaches"].startswith(reaches)
    assert any("ROS_DOMAIN_ID is '-1'" in finding.what and finding.stops_arms for finding in findings)


@pytest.mark.parametrize(("name", "told"), [("rmw_zenoh_cpp", True), ("rmw_fastrtps_cpp", False)])
def test_for_a_middleware_without_acknowledgements_a_note_says_that_hanging_receivers_are_not_found(
    name: str, told: bool
) -> None:
    _, findings = examine_environment({"RMW_IMPLEMENTATION": name, "ROS_DOMAIN_ID": "-1"})
    assert told == any("has no acknowledgements" in one.what and not one.stops_arms for one in findings)
