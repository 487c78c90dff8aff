"""What RViz, Foxglove and PlotJuggler are told to show is there, with the type and the fields that they expect."""

from __future__ import annotations

import json
import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from q2r2_control import Robot
from q2r2_control.recording.messages import Topic, run_topics
from tests.ros.cell import PATIENT, start_controller, start_robot
from tests.ros.conftest import need_ros
from tests.ros.processes import ROOT, Processes
from tests.ros.waiting import wait_until

need_ros()

VIEWS = ROOT / "views"
# The types that RViz's displays and Foxglove's panels take.
KINDS = {
    "RobotModel": "std_msgs/msg/String",
    "Marker": "visualization_msgs/msg/Marker",
    "Pose": "geometry_msgs/msg/PoseStamped",
    "TF": "tf2_msgs/msg/TFMessage",
    "DiagnosticSummary": "diagnostic_msgs/msg/DiagnosticArray",
    "RawMessages": "std_msgs/msg/String",
}
POSE, MARKER = KINDS["Pose"], KINDS["Marker"]


def rviz_topics() -> dict[str, str]:
    """Type by topic, of every display that shows one."""
    found = {}
    for display in yaml.safe_load((VIEWS / "q2r2.rviz").read_text())["Visualization Manager"]["Displays"]:
        kind = display["Class"].removeprefix("rviz_default_plugins/")
        if kind != "Grid":
            topic = display.get("Topic") or display.get("Description Topic") or {"Value": "/tf"}
            found[topic["Value"]] = KINDS[kind]
    return found


def foxglove_panels() -> dict[str, Any]:
    panels: dict[str, Any] = json.loads((VIEWS / "foxglove.json").read_text())["configById"]
    return panels


def foxglove_topics() -> dict[str, str]:
    """Type by topic, of all but plots."""
    panels = foxglove_panels()
    found = {topic: POSE if "safe_target" in topic else MARKER for topic in panels["3D!arms"]["topics"]}
    found[panels["3D!arms"]["layers"]["arms"]["topic"]] = KINDS["RobotModel"]
    found[panels["RawMessages!controller"]["topicPath"].removesuffix(".data")] = KINDS["RawMessages"]
    found[panels["DiagnosticSummary!nodes"]["topicToRender"]] = KINDS["DiagnosticSummary"]
    return found


def foxglove_paths() -> list[str]:
    return [path["value"] for panel in foxglove_panels().values() for path in panel.get("paths", ())]


@pytest.fixture(scope="module")
def recorded(robot: Robot) -> dict[str, Topic]:
    return run_topics(tuple(robot.arms), robot.joint_names)


def check_field(topic: Topic, fields: list[str]) -> None:
    """Check that a path of fields ends at a number of the topic's message, and that its index is one of those there."""
    store: Any = get_typestore(Stores.ROS2_JAZZY)
    kind = topic.type
    for field in fields:
        name, _, index = field.partition("[")
        detail = dict(store.fielddefs[kind][1])[name][1]
        if index:
            assert not topic.labels or int(index.rstrip("]")) < len(topic.labels)
            detail = detail[0][1]
        kind = detail if isinstance(detail, str) else detail[0]
    assert kind == "float64"


def test_every_plot_of_a_recording_has_its_field(recorded: dict[str, Topic]) -> None:
    curves = [curve.attrib["name"] for curve in ElementTree.parse(VIEWS / "plotjuggler.xml").iter("curve")]
    assert len(curves) > 20
    for curve in curves:
        (name,) = (name for name in recorded if curve.startswith(f"{name}/"))
        check_field(recorded[name], curve.removeprefix(f"{name}/").split("/"))
    for path in foxglove_paths():
        name, _, fields = path.partition(".")
        check_field(recorded[name], fields.split("."))


def test_no_view_of_a_running_set_listens_to_a_command() -> None:
    shown = {
        *recorded_by_hand(),
        *rviz_topics(),
        *foxglove_topics(),
        *(path.partition(".")[0] for path in foxglove_paths()),
    }
    assert not [name for name in shown if re.search(r"target_frame|trajectory|command|_hand_", name)]


def recorded_by_hand() -> list[str]:
    """The topics that the docs record a running set with."""
    (command,) = re.findall(r"ros2 bag record (.*)", (ROOT / "docs" / "ros.md").read_text())
    return list(command.split())


@pytest.mark.alone
def test_every_display_shows_what_the_set_publishes(node: Any, robot: Robot, processes: Processes) -> None:
    from visualization_msgs.msg import Marker

    start_robot(processes)
    start_controller(processes, *PATIENT)
    processes.start_node("arm_controllers", "rate:=50.0")
    wanted = rviz_topics() | foxglove_topics()

    def missing() -> dict[str, str]:
        types = dict(node.get_topic_names_and_types())
        return {
            name: kind for name, kind in wanted.items() if types.get(name) != [kind] or not node.count_publishers(name)
        }

    wait_until(lambda: not missing(), "all that is shown is published", missing)
    assert [name for name in recorded_by_hand() if not node.count_publishers(name)] == []
    markers: list[Any] = []
    node.create_subscription(Marker, "/cartesian_controller/distances", markers.append, 10)
    wait_until(lambda: markers, "the closest pair is shown")
    ends = [np.array([point.x, point.y, point.z]) for point in markers[-1].points]
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(min(robot.distance_values(robot.home)), abs=2e-3)
