"""The message packages as other ROS programs use them: types, type hashes, topics and actions between processes."""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.ros.conftest import need_ros

need_ros()

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
