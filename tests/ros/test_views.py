"""The topics and code of the views, the README and the docs exist and work unchanged."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from q2r2_control import Robot
from q2r2_control.recording.messages import Topic, run_topics
from tests.ros.cell import PATIENT, start_controller, start_robot
from tests.ros.conftest import need_ros
from tests.ros.processes import PATIENCE, ROOT, Processes, as_arguments, wait_until

need_ros()

from q2r2_control.ros.base_node import LATCHED_QOS
from q2r2_control.ros.bridge.messages import pose_of
from tests.ros.arm_rig import TOOL, ArmRig, assert_same, offset, patient, stamped_transform, target_of

VIEWS = ROOT / "views"

# The displays of RViz and the panels of Foxglove accept these types.
TEXT, POSE, MARKER = "std_msgs/msg/String", "geometry_msgs/msg/PoseStamped", "visualization_msgs/msg/Marker"
KINDS = {"RobotModel": TEXT, "Marker": MARKER, "Pose": POSE, "TF": "tf2_msgs/msg/TFMessage"}


def rviz_topics() -> dict[str, str]:
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
    panels = foxglove_panels()
    found = {topic: POSE if "safe_target" in topic else MARKER for topic in panels["3D!arms"]["topics"]}
    found[panels["3D!arms"]["layers"]["arms"]["topic"]] = TEXT
    found[panels["RawMessages!controller"]["topicPath"].removesuffix(".data")] = TEXT
    found[panels["DiagnosticSummary!nodes"]["topicToRender"]] = "diagnostic_msgs/msg/DiagnosticArray"
    return found


def foxglove_paths() -> list[str]:
    return [path["value"] for panel in foxglove_panels().values() for path in panel.get("paths", ())]


def check_field(topic: Topic, fields: list[str]) -> None:
    """Check that a path of fields ends at a number of the topic's message, and that its index exists."""
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


def test_every_field_that_a_view_plots_exists_in_a_recording(robot: Robot) -> None:
    recorded = run_topics(tuple(robot.arms), robot.joint_names)
    curves = [curve.attrib["name"] for curve in ElementTree.parse(VIEWS / "plotjuggler.xml").iter("curve")]
    assert len(curves) > 20
    for curve in curves:
        (name,) = (name for name in recorded if curve.startswith(f"{name}/"))
        check_field(recorded[name], curve.removeprefix(f"{name}/").split("/"))
    for path in foxglove_paths():
        name, _, fields = path.partition(".")
        check_field(recorded[name], fields.split("."))


def test_no_view_of_a_running_set_subscribes_to_a_command() -> None:
    plotted = [path.partition(".")[0] for path in foxglove_paths()]
    shown = {*recorded_by_hand(), *rviz_topics(), *foxglove_topics(), *plotted}
    assert not [name for name in shown if re.search(r"target_frame|trajectory|command|_hand_", name)]


def recorded_by_hand() -> list[str]:
    (command,) = re.findall(r"ros2 bag record (.*)", (ROOT / "docs" / "ros.md").read_text())
    return list(command.split())


@pytest.mark.alone
def test_every_display_shows_a_topic_that_the_set_publishes(node: Any, robot: Robot, processes: Processes) -> None:
    from visualization_msgs.msg import Marker

    start_robot(processes)
    start_controller(processes, *PATIENT)
    processes.start_node("arm_controllers", "rate:=50.0")
    wanted = rviz_topics() | foxglove_topics()
    by_others = node.create_publisher(Marker, "/cartesian_controller/obstacles", 1)
    assert by_others.topic_name in wanted

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


MOVED = 0.05  # [rad]


@pytest.mark.alone
def test_the_documented_subclass_works_in_its_robots_frame(node: Any, processes: Processes, tmp_path: Path) -> None:
    from tf2_msgs.msg import TFMessage
    from visualization_msgs.msg import Marker

    base = pin.SE3(pin.exp3(np.array([0.0, 0.0, 1.2])), np.array([0.1, -0.4, 0.3]))
    static = node.create_publisher(TFMessage, "/tf_static", LATCHED_QOS)
    static.publish(TFMessage(transforms=[stamped_transform("world", "bh_robot_base", base)]))
    shown: dict[str, Any] = {}
    node.create_subscription(Marker, "/visualization_marker", lambda marker: shown.update({marker.ns: marker}), 10)

    topic = "/bh_robot/right_arm_clik_controller/target_frame"
    rig = ArmRig(node, "right", topic=topic, tool_frame="right_arm_link_ee", robot="bh_robot")
    rig.follows = False
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "ros.md").read_text(), re.DOTALL)
    (file := tmp_path / "right_arm.py").write_text(code)
    given = patient({"world_frame_id": "world", "teleop.leash.distance": 0.0})
    process = processes.start(sys.executable, str(file), *as_arguments(*given), name="right_arm")
    rig.wait_until_connected()
    rig.engage()
    rig.wait(lambda: rig.targets, "targets come")
    assert rig.state["preset"] == "kuka_lbr_clik", "not the terms of another controller"
    assert rig.targets[0].header.frame_id == "bh_robot_base"
    assert_same(base * target_of(rig), TOOL, 1e-9)
    rig.move((0.0, 0.1, 0.0))
    assert_same(base * rig.wait_for_rest(), offset(TOOL, (0.0, 0.1, 0.0)), 1e-3)

    rig.wait(lambda: {"right_engaged", "right_axes", "right_path"} <= shown.keys(), "markers come")
    assert shown["right_axes"].header.frame_id == "right_arm_link_ee"
    assert_same(TOOL * (pose_of(shown["right_axes"].pose) or pin.SE3.Identity()), offset(TOOL, (0.0, 0.1, 0.0)), 2e-3)
    rig.pause()
    rig.wait(lambda: shown["right_engaged"].color.a < 1.0, "the marker fades")
    assert_same(pose_of(shown["right_engaged"].pose), pin.SE3.Identity(), 1e-9)
    assert process.interrupt(PATIENCE) == 0
