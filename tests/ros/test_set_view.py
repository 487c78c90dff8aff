"""Why an arm moves or does not, in words, by what its node and the controller say."""

from __future__ import annotations

from typing import Any

import pytest

from q2r2_control import load_config
from q2r2_control.ros.watching.set_view import NodeView, arm_views
from tests.ros.processes import CONFIG

CELL = load_config(CONFIG)
ARM = {"arm": "left", "hand": "left", "state": "idle", "ready": False, "hand_age": 0.01, "slip": 0.0}


def node(name: str, message: str = "running", level: str = "ok", age: float = 0.1, **values: Any) -> NodeView:
    return NodeView(name, level, message, age, values)


def arm(message: str = "running", age: float = 0.1, **values: Any) -> NodeView:
    return node("/left_arm", message, "ok", age, **(ARM | values))


CONTROLLER = node(
    "/controller", phase="active", left_state="following", closest_distance_m=0.0213, closest_pair="a_0|b_1"
)
REFUSING = node("/controller", "target of left not used: begins 4 cm off", "warn", phase="active")


@pytest.mark.parametrize(
    ("nodes", "why"),
    [
        pytest.param((), "no node teleoperates this arm", id="no node"),
        pytest.param((arm(age=7.2),), "/left_arm is silent for 7 s", id="a silent node"),
        pytest.param((arm("/target has no subscriber"),), "/target has no subscriber", id="something in the way"),
        pytest.param(
            (arm(ready=True, last_event="lost: cable"),),
            "lower of the left hand engages (last: lost: cable)",
            id="ready",
        ),
        pytest.param(
            (arm("stopped: by the left hand", state="stopped"),), "/left_arm/reset, or", id="stopped by a person"
        ),
        pytest.param((arm(state="homing"),), "goes home", id="on the way home"),
        pytest.param((arm(state="engaged"), CONTROLLER), "follows the hand", id="engaged"),
        pytest.param((arm(state="engaged", hand_age=3.4),), "no pose of the left hand for 3 s", id="no hand"),
        pytest.param(
            (arm(state="engaged", slip=0.012), CONTROLLER),
            "12 mm short of the hand; nearest pair a_0 | b_1, 21 mm",
            id="held up",
        ),
        pytest.param((arm(state="engaged"), REFUSING), "/controller: target of left not used", id="refused"),
        pytest.param((arm(state="engaged", hand_age="old", slip=None),), "follows the hand", id="strange values"),
    ],
)
def test_a_line_says_why_an_arm_is_where_it_is(nodes: tuple[NodeView, ...], why: str) -> None:
    left, right = arm_views(nodes, CELL)
    assert why in left.why
    assert (left.name, right.name, right.node) == ("left", "right", "")


def test_two_nodes_of_one_arm_are_two_rows() -> None:
    views = arm_views((arm(), NodeView("/other", "ok", "running", 0.1, ARM)), CELL)
    assert [(view.name, view.node) for view in views] == [("left", "/left_arm"), ("left", "/other"), ("right", "")]
