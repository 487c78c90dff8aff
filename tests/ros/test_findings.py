"""What is wrong with a set of nodes, and what helps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from q2r2_control import load_config
from q2r2_control.ros.watching.findings import Finding, examine_set
from q2r2_control.ros.watching.set_view import NodeView, SetView, TopicView, arm_views
from tests.ros.processes import CONFIG

CELL = load_config(CONFIG)
EXPECTED = ("mujoco_robot", "cartesian_controller", "left_arm_controller", "right_arm_controller")


def node(name: str, **values: Any) -> NodeView:
    return NodeView(name, values.pop("level", "ok"), values.pop("message", "fine"), values.pop("age", 0.1), values)


def topic(name: str, publishers: tuple[str, ...], subscribers: tuple[str, ...], *types: str) -> TopicView:
    return TopicView(name, types or ("some/msg/Type",), publishers, subscribers, None)


def arm(name: str, **values: Any) -> NodeView:
    given = {
        "arm": name,
        "hand": name,
        "state": "idle",
        "ready": True,
        "engaged": False,
        "sent": {f"/{name}/target": 1},
    }
    return node(f"/{name}_arm", **(given | values))


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
    """A good set with some nodes and topics in the place of those with the same names."""
    parts: dict[str, Any] = {one.name: one for one in (CONTROLLER, ROBOT, LEFT, RIGHT, HAND, *TOPICS)}
    parts |= {one.name: one for one in changed}
    parts.pop(without, None)
    nodes = tuple(one for one in parts.values() if isinstance(one, NodeView))
    topics = tuple(one for one in parts.values() if isinstance(one, TopicView))
    return replace(SetView(nodes, topics, tuple(one.name for one in nodes), arm_views(nodes, CELL)), **fields)


def found(seen: SetView) -> list[Finding]:
    return examine_set(seen, EXPECTED)


def test_nothing_is_found_in_a_good_set_nor_where_none_runs() -> None:
    assert found(view()) == []
    assert found(SetView((), (), ("/stranger",), arm_views((), CELL))) == []


@pytest.mark.parametrize(
    ("seen", "what", "cure"),
    [
        pytest.param(
            view(topic("/left/target", ("/left_arm", "/x"), ("/controller",))),
            "2 publishers of /left/target: /left_arm, /x",
            "end all but one",
            id="two publishers of a target",
        ),
        pytest.param(
            view(topic("/positions", ("/x",), ("/robot",))),
            "/robot is commanded by several",
            "end",
            id="two commanders",
        ),
        pytest.param(
            view(
                node("/other", phase="active", left_state="holding"),
                topic("/left/target", ("/left_arm",), ("/controller", "/other")),
            ),
            "two controllers take /left/target: /controller, /other",
            "end all but one",
            id="two controllers",
        ),
        pytest.param(view(names=("/robot", "/robot")), "2 nodes are called /robot", "end", id="one node twice"),
        pytest.param(view(without="/left_arm"), "the left arm: no node", "start left_arm_controller", id="no arm"),
        pytest.param(view(without="/controller"), "no built-in controller", "start cartesian", id="no controller"),
        pytest.param(view(without="/joint_states"), "nothing publishes joint states", "start the", id="no robot"),
        pytest.param(view(node("/robot", age=5.0)), "/robot is silent for 5 s", "restart it", id="silent"),
        pytest.param(
            view(arm("left", clock_problem="use_sim_time is set and nothing comes on /clock")),
            "/left_arm: use_sim_time is set and nothing comes on /clock",
            "without use_sim_time",
            id="no clock",
        ),
        pytest.param(
            view(arm("left", ready=False, message="/left/target has no subscriber", kind="no_subscriber")),
            "the left arm: /left/target has no subscriber",
            "start the arm's controller",
            id="an arm that is not ready",
        ),
        pytest.param(
            view(arm("left", ready=False, message="/c is stopped: by hand; call /c/reset", kind="controller_refuses")),
            "/c is stopped",
            "/c/reset",
            id="stop",
        ),
    ],
)
def test_what_stops_the_arms_is_found_with_its_cure(seen: SetView, what: str, cure: str) -> None:
    assert [one for one in found(seen) if one.stops_arms and what in one.what and cure in one.cure], found(seen)


def test_controllers_of_an_arm_each_may_share_a_topic_of_commands() -> None:
    left = node("/controller", phase="active", left_state="holding", sent={"/commands": 1})
    right = node("/other", phase="active", right_state="holding", sent={"/commands": 1})
    assert found(view(left, right, topic("/commands", ("/controller", "/other"), ("/robot",)))) == []


def test_a_second_taker_of_commands_is_a_warning() -> None:
    (finding,) = found(view(topic("/commands", ("/controller",), ("/robot", "/echo"))))
    assert "2 takers: /robot, /echo" in finding.what
    assert not finding.stops_arms
