"""The message packages as other ROS programs use them: types, type hashes, topics and actions between processes."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from queue import Queue
from threading import Event
from typing import Any

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import PATIENCE, Processes

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytestmark = pytest.mark.usefixtures("interfaces")

# ros2 topic info --verbose /tf says so on ROS 2 Jazzy.
TF_HASH = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
# What docs.ros.org/en/jazzy/p/control_msgs lists, in its order; a type hash depends on names and types of fields alone.
GRIPPER_STATE = "float64 position\nfloat64 effort\nbool stalled\nbool reached_goal"
PUBLISHED_FIELDS = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "control_msgs/msg/GripperCommand": "float64 position\nfloat64 max_effort",
    "control_msgs/action/GripperCommand_Goal": "control_msgs/GripperCommand command",
    "control_msgs/action/GripperCommand_Result": GRIPPER_STATE,
    "control_msgs/action/GripperCommand_Feedback": GRIPPER_STATE,
    "control_msgs/action/ParallelGripperCommand_Goal": "sensor_msgs/JointState command",
    "control_msgs/action/ParallelGripperCommand_Result": (
        "sensor_msgs/JointState state\nbool stalled\nbool reached_goal"
    ),
    "control_msgs/action/ParallelGripperCommand_Feedback": "sensor_msgs/JointState state",
}


TOPIC = "q2r_left_hand_inputs"
INPUTS = {
    "button_upper": False,
    "button_lower": True,
    "thumb_stick_horizontal": -0.5,
    "thumb_stick_vertical": 0.25,
    "press_index": 0.75,
    "press_middle": 1.0,
}


def built_hash(kind: str) -> str:
    """The type hash that the generators wrote beside the installed definition."""
    package, folder, name = kind.split("/")
    module = Path(import_module(package).__path__[0])  # prefix/lib/python3.x/site-packages/package
    file = module.parents[3] / "share" / package / folder / f"{name.split('_')[0]}.json"
    hashes = json.loads(file.read_text())["type_hashes"]
    return next(entry["hash_string"] for entry in hashes if entry["type_name"] == kind)


def published_hash(kind: str) -> str:
    """The type hash of the published fields, computed by rosbags from its own definitions of what they contain."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, fields in PUBLISHED_FIELDS.items():
        store.register(get_types_from_msg(fields, name))
    return store.hash_rihs01(kind)


@pytest.mark.parametrize("kind", PUBLISHED_FIELDS)
def test_a_type_has_the_hash_of_its_published_fields(kind: str) -> None:
    assert built_hash(kind) == published_hash(kind)


def test_tf_has_the_hash_that_jazzy_prints() -> None:
    assert built_hash("tf2_msgs/msg/TFMessage") == TF_HASH


def test_inputs_of_a_hand_arrive_from_another_process(node: Any, processes: Processes) -> None:
    from quest2ros.msg import OVR2ROSInputs

    received: Queue[Any] = Queue()
    node.create_subscription(OVR2ROSInputs, TOPIC, received.put, 10)
    program = "tests.ros.programs.publish"
    headset = processes.start_module(program, "quest2ros/OVR2ROSInputs", TOPIC, json.dumps(INPUTS))
    message = received.get(timeout=PATIENCE)
    assert {name: getattr(message, name) for name in INPUTS} == INPUTS
    (publisher,) = node.get_publishers_info_by_topic(f"/{TOPIC}")
    assert str(publisher.topic_type_hash) == built_hash("quest2ros/msg/OVR2ROSInputs")
    assert headset.interrupt() == 0


def test_a_gripper_in_another_process_takes_a_goal_and_can_be_cancelled(node: Any, processes: Processes) -> None:
    from action_msgs.msg import GoalStatus
    from control_msgs.action import GripperCommand
    from rclpy.action import ActionClient

    from tests.ros.programs.gripper import HELD, OPEN

    gripper = processes.start_module("tests.ros.programs.gripper")
    gripper.wait_for("ready")
    client = ActionClient(node, GripperCommand, "gripper/command")
    assert client.wait_for_server(PATIENCE)
    goal = GripperCommand.Goal()
    goal.command.position = 0.0
    goal.command.max_effort = 40.0
    feedbacks: Queue[Any] = Queue()
    handle = outcome(client.send_goal_async(goal, feedbacks.put))
    assert handle.accepted

    # Feedback is a topic of its own: the first messages may be sent before both sides know each other.
    last = OPEN
    while not (feedback := feedbacks.get(timeout=PATIENCE).feedback).stalled:
        assert HELD < feedback.position <= last
        last = feedback.position
    assert feedback.position == HELD

    outcome(handle.cancel_goal_async())
    answer = outcome(handle.get_result_async())
    assert answer.status == GoalStatus.STATUS_CANCELED
    assert (answer.result.position, answer.result.effort) == (HELD, 40.0)
    assert (answer.result.stalled, answer.result.reached_goal) == (True, False)
    assert gripper.interrupt() == 0


def outcome(future: Any) -> Any:
    """What a future of rclpy ends with, while another thread spins."""
    done = Event()
    future.add_done_callback(lambda _: done.set())
    assert done.wait(PATIENCE), "no answer"
    return future.result()
