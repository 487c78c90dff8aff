"""The listener of a set hears the reports of nodes and their rates, and does not influence them."""

from __future__ import annotations

import itertools
import json
import os
import sys
import time
from contextlib import suppress
from typing import Any

import pytest
from geometry_msgs.msg import PoseStamped
from rclpy._rclpy_pybind11 import NodeNameNonExistentError
from std_msgs.msg import String

from q2r2_control import load_config
from q2r2_control.events import Reason
from q2r2_control.ros.reasons import RosReason
from q2r2_control.ros.watching.set_listener import SetListener
from q2r2_control.ros.watching.set_view import NodeView, arm_views
from q2r2_control.supervision.reasons import SupervisionReason
from tests.ros.conftest import need_ros, spun_node
from tests.ros.processes import CONFIG, PATIENCE, Processes, States, wait_until

need_ros()


# Time limit of a command, which first tries ROS in a separate process and then listens [s].
LONG = 4.0 * PATIENCE
COMMAND = (sys.executable, "-m", "q2r2_control", "ros")
CELL = load_config(CONFIG)
NO_TOOL_POSE = RosReason.NO_TOOL_POSE.template.format(cause="")


def test_a_set_listener_tells_the_rates_of_the_senders_and_subscribes_only_to_states(node: Any, domain: int) -> None:
    state = node.create_publisher(String, "/test/state", 10)
    other = node.create_publisher(String, "/stranger/state", 10)
    sender = node.create_publisher(PoseStamped, "/target", 10)
    counts = itertools.count()

    def publish() -> None:
        said = {"level": "ok", "message": "here", "sent": {"/target": next(counts)}}
        state.publish(String(data=json.dumps(said)))
        for text in ("not JSON", "[1]", '{"level": 1}'):
            other.publish(String(data=text))

    timer = node.create_timer(0.01, publish)
    with spun_node(domain, "watcher") as watcher:
        listener = SetListener(watcher, CELL)

        def rates() -> dict[str, float | None]:
            listener.look()
            return {topic.name: topic.rate for topic in listener.view().topics}

        wait_until(lambda: (rates().get("/target") or 0.0) > 10.0, "the topics have rates")
        # What this node reports is not a valid state.
        assert "/stranger" not in {one.name for one in listener.view().nodes}
        assert node.count_subscribers("/target") == 0
    node.destroy_timer(timer)
    node.destroy_publisher(sender)


def test_a_watch_shuts_its_executor_down_before_python_ends(node: Any, processes: Processes) -> None:
    # When Python ends, it destroys the remaining objects in any order. rclpy prints a traceback if an executor is
    # destroyed after its parts.
    code = f"""
import gc
from rclpy.executors import Executor
from q2r2_control import load_config
from q2r2_control.ros.watching.set_listener import watch_set
gc.disable()
seen = []
watch_set(load_config({CONFIG!r}), None, lambda view: seen.extend(view.nodes), lambda: bool(seen))
print("left:", sum(isinstance(one, Executor) for one in gc.get_objects()))
"""
    state = node.create_publisher(String, "/test/state", 10)
    message = String(data=json.dumps({"level": "ok", "message": "here"}))
    # Messages come all the time, so that the last spin ends because of a message.
    timer = node.create_timer(0.01, lambda: state.publish(message))
    watch = processes.start(sys.executable, "-c", code, name="watch")
    assert watch.wait_for("left:") == "left: 0"
    node.destroy_timer(timer)


def test_the_command_watch_shows_nodes_and_subscribes_to_no_commands_and_no_hand_data(
    node: Any, processes: Processes
) -> None:
    processes.start_node("left_arm_controller")
    processes.start_node("SimulationInput")
    States(node, "left_q2r2_arm_controller").wait_for(kind="no_tool_pose")
    states = States(node, "simulation_input")
    states.wait_for(without_subscriber=["right"])
    watch = processes.start(*COMMAND, "watch", "--json", "--duration", "8", name="watch")
    name = f"q2r2_watch_{watch.pid}"
    taken: set[str] = set()

    def look() -> bool:
        # The call raises this error before the graph knows the command's node, and after the node has ended.
        with suppress(NodeNameNonExistentError):
            taken.update(topic for topic, _ in node.get_subscriber_names_and_types_by_node(name, "/"))
        return "/left_q2r2_arm_controller/state" in taken

    wait_until(look, "the command hears the arm", lambda: taken)
    end = time.monotonic() + LONG
    while watch.running and time.monotonic() < end:
        look()
        time.sleep(0.05)
    assert {topic.rpartition("/")[2] for topic in taken} == {"state"}
    states.wait_for(without_subscriber=["right"])  # The scripted hands do not play for a listener.
    assert watch.wait(LONG) == 0
    found = json.loads(watch.output.splitlines()[-1])
    left, right = found["arms"]
    assert left["node"] == "/left_q2r2_arm_controller"
    assert NO_TOOL_POSE in left["why"]
    assert right["why"].startswith("no node teleoperates this arm")
    topics = {topic["name"]: topic for topic in found["topics"]}
    assert topics["/q2r2/left/target_frame"]["subscribers"] == []
    assert topics["/q2r_left_hand_pose"]["publishers"] == ["/simulation_input"]


@pytest.mark.slow
def test_the_doctor_finds_two_inputs_and_an_absent_controller_and_their_cures(node: Any, processes: Processes) -> None:
    processes.start_node("left_arm_controller")
    for number in (1, 2):
        processes.start_node("SimulationInput", "side:=left", node=f"input_{number}")
    States(node, "left_q2r2_arm_controller").wait_for(kind="several_publishers")
    States(node, "input_1").wait_for()
    States(node, "input_2").wait_for()
    doctor = processes.start(*COMMAND, "doctor", "--duration", "6", "--json", name="doctor")
    assert doctor.wait(LONG) == 1
    found = json.loads(doctor.output.splitlines()[-1])
    assert found["domain"] == os.environ["ROS_DOMAIN_ID"]
    assert found["middleware"].startswith("rmw_")
    assert "/left_q2r2_arm_controller" in found["nodes"]
    cures = {finding["what"]: finding["cure"] for finding in found["findings"] if finding["stops_arms"]}
    assert "end all but one" in cures["2 publishers of /q2r_left_hand_pose: /input_1, /input_2"]
    (what,) = (what for what in cures if what.startswith("the left arm: 2 publishers of /q2r_left_hand_"))
    assert "/input_1 and /input_2" in what
    assert "end all but one" in cures[what]
    assert "start cartesian_controller" in cures["no built-in controller runs"]


def test_the_doctor_says_why_no_node_can_start(processes: Processes) -> None:
    doctor = processes.start(*COMMAND, "doctor", name="doctor", RMW_IMPLEMENTATION="rmw_nothing_cpp")
    assert doctor.wait(LONG) == 1
    (line,) = (line for line in doctor.output.splitlines() if line.startswith("stops arms"))
    assert "no node can start" in line


ARM = {"arm": "left", "hand": "left", "state": "idle", "ready": False, "hand_age": 0.01, "slip": 0.0}


def node(name: str, message: str = "running", level: str = "ok", age: float = 0.1, **values: Any) -> NodeView:
    return NodeView(name, level, message, age, values)


def arm(message: str = "running", age: float = 0.1, **values: Any) -> NodeView:
    return node("/left_arm", message, "ok", age, **(ARM | values))


CONTROLLER = node(
    "/controller", phase="active", left_state="following", closest_distance_m=0.0213, closest_pair="a_0|b_1"
)
REFUSED = Reason.of(SupervisionReason.TWO_PUBLISHERS, arm="left", source="").as_json()
REFUSING = node("/controller", "a target of one not used", "warn", phase="active", left_target_refusal=REFUSED)
OTHER_REFUSED = node("/controller", "left out of this", "warn", phase="active", right_target_refusal=REFUSED)
FAULT = node("/controller", "wrong", "error", phase="braking", fault=Reason(RosReason.STOP_SERVICE).as_json())

ENGAGED = arm(state="engaged")
HELD_UP = arm(state="engaged", slip=0.012), CONTROLLER
READY = arm(ready=True, last_event="lost: cable")
WHY: dict[str, tuple[tuple[NodeView, ...], str]] = {
    "no node": ((), "no node teleoperates this arm"),
    "a silent node": ((arm(age=7.2),), "/left_arm is silent for 7 s"),
    "something in the way": ((arm("/target has no subscriber"),), "/target has no subscriber"),
    "ready": ((READY,), "A or X of the left hand engages (last: lost: cable)"),
    "stopped by a person": ((arm("stopped: by the left hand", state="stopped"),), "/left_arm/reset, or"),
    "on the way home": ((arm(state="homing"),), "goes home"),
    "engaged": ((ENGAGED, CONTROLLER), "follows the hand"),
    "no hand": ((arm(state="engaged", hand_age=3.4),), "no pose of the left hand for 3 s"),
    "held up": (HELD_UP, "12 mm short of the hand; nearest pair a_0 | b_1, 21 mm"),
    "refused": ((ENGAGED, REFUSING), f"/controller: {SupervisionReason.TWO_PUBLISHERS.template.format(source='')}"),
    "another arm's refused": ((ENGAGED, OTHER_REFUSED), "follows the hand"),
    "stopped": ((ENGAGED, FAULT), f"/controller: {RosReason.STOP_SERVICE.template}"),
    "strange values": ((arm(state="engaged", hand_age="old", slip=None),), "follows the hand"),
}


@pytest.mark.parametrize(("nodes", "why"), WHY.values(), ids=WHY)
def test_the_view_of_an_arm_gives_the_reason_for_its_state(nodes: tuple[NodeView, ...], why: str) -> None:
    left, right = arm_views(nodes, CELL)
    assert why in left.why
    assert (left.name, right.name, right.node) == ("left", "right", "")


def test_two_nodes_of_one_arm_have_two_views() -> None:
    views = arm_views((arm(), NodeView("/other", "ok", "running", 0.1, ARM)), CELL)
    assert [(view.name, view.node) for view in views] == [("left", "/left_arm"), ("left", "/other"), ("right", "")]
