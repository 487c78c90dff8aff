"""What listens to a set: it hears what nodes say and how often, and takes no part in what they do."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped
from std_msgs.msg import String

from q2r2_control import load_config
from q2r2_control.ros.watching.set_listener import SetListener
from q2r2_control.ros.watching.set_view import NodeView, arm_views
from tests.ros.conftest import need_ros, spun_node
from tests.ros.processes import CONFIG, PATIENCE, Processes
from tests.ros.waiting import States, wait_until

need_ros()


# The command tries ROS in a process of its own first, and listens for seconds [s].
LONG = 4.0 * PATIENCE


@pytest.fixture
def listener(domain: int) -> Iterator[SetListener]:
    with spun_node(domain, "watcher") as watcher:
        yield SetListener(watcher, load_config(CONFIG))


def test_what_one_may_listen_to_is_measured_and_what_not_is_what_the_sender_says(
    node: Any, listener: SetListener
) -> None:
    state = node.create_publisher(String, "/test/state", 10)
    other = node.create_publisher(String, "/stranger/state", 10)
    sender = node.create_publisher(PoseStamped, "/target", 10)
    counted = 0

    def publish() -> None:
        nonlocal counted
        counted += 1
        state.publish(String(data=json.dumps({"level": "ok", "message": "here", "sent": {"/target": counted}})))
        for text in ("not JSON", "[1]", '{"level": 1}'):
            other.publish(String(data=text))

    timer = node.create_timer(0.01, publish)

    def views() -> Any:
        listener.look()
        time.sleep(0.05)
        return listener.view()

    def measured() -> bool:
        return "/target" in {topic.name for topic in views().topics if topic.rate}

    wait_until(measured, "the topics have rates")
    view = views()
    assert "/stranger" not in {one.name for one in view.nodes}  # which says something else
    node.destroy_timer(timer)
    topics = {topic.name: topic for topic in view.topics}
    assert topics["/target"].rate is not None
    assert topics["/target"].rate > 0.0
    assert node.count_subscribers("/target") == 0
    node.destroy_publisher(sender)


def test_the_command_watches_nodes_and_subscribes_to_no_command_and_no_hand(node: Any, processes: Processes) -> None:
    processes.start_node("left_arm_controller")
    processes.start_node("SimulationInput")
    States(node, "left_q2r2_arm_controller").wait_for("not known")
    states = States(node, "simulation_input")
    states.wait_for("waits for a subscriber of the right hand")
    watch = processes.start(
        sys.executable, "-m", "q2r2_control", "ros", "watch", "--json", "--duration", "8", name="watch"
    )
    name = f"q2r2_watch_{watch.pid}"
    taken: set[str] = set()

    def look() -> bool:
        if (name, "/") in node.get_node_names_and_namespaces():
            taken.update(topic for topic, _ in node.get_subscriber_names_and_types_by_node(name, "/"))
        return "/left_q2r2_arm_controller/state" in taken

    wait_until(look, "the command hears the arm", lambda: taken)
    end = time.monotonic() + LONG
    while watch.running and time.monotonic() < end:
        look()
        time.sleep(0.05)
    assert {topic.rpartition("/")[2] for topic in taken} == {"state"}
    states.wait_for("waits for a subscriber of the right hand")  # it does not play for who watches
    assert watch.wait(LONG) == 0
    found = json.loads(watch.output.splitlines()[-1])
    left, right = found["arms"]
    assert left["node"] == "/left_q2r2_arm_controller"
    assert "the tool's pose is not known" in left["why"]
    assert right["why"].startswith("no node teleoperates this arm")
    topics = {topic["name"]: topic for topic in found["topics"]}
    assert topics["/q2r2/left/target_frame"]["subscribers"] == []
    assert topics["/q2r_left_hand_pose"]["publishers"] == ["/simulation_input"]


@pytest.mark.slow
def test_the_doctor_finds_two_inputs_and_an_arm_without_its_robot_and_says_what_helps(
    node: Any, processes: Processes
) -> None:
    processes.start_node("left_arm_controller")
    for number in (1, 2):
        processes.run_node("SimulationInput", "-r", f"__node:=input_{number}", "-p", "side:=left")
    States(node, "left_q2r2_arm_controller").wait_for("not known")
    States(node, "input_1").wait_for("")
    States(node, "input_2").wait_for("")
    arguments = ("ros", "doctor", "--duration", "6")
    doctor = processes.start(sys.executable, "-m", "q2r2_control", *arguments, "--json", name="doctor")
    assert doctor.wait(LONG) == 1
    found = json.loads(doctor.output.splitlines()[-1])
    assert found["domain"] == os.environ["ROS_DOMAIN_ID"]
    assert found["middleware"].startswith("rmw_")
    assert "/left_q2r2_arm_controller" in found["nodes"]
    cures = {finding["what"]: finding["cure"] for finding in found["findings"] if finding["stops_arms"]}
    assert "end all but one" in cures["2 publishers of /q2r_left_hand_pose: /input_1, /input_2"]
    (what,) = (what for what in cures if what.startswith("the left arm: the tool's pose is not known"))
    assert "start the robot" in cures[what]
    assert "start cartesian_controller" in cures["no built-in controller runs"]


def test_the_doctor_says_why_no_node_can_start(processes: Processes) -> None:
    command = (sys.executable, "-m", "q2r2_control", "ros", "doctor")
    doctor = processes.start(*command, name="doctor", RMW_IMPLEMENTATION="rmw_nothing_cpp")
    assert doctor.wait(LONG) == 1
    (line,) = (line for line in doctor.output.splitlines() if line.startswith("stops arms"))
    assert "no node can start" in line


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
