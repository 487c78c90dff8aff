"""What the doctor looks for in an environment."""

from __future__ import annotations

import ast

import pytest

from q2r2_control.ros.watching.findings import PACKAGES, examine_environment
from tests.ros.processes import ROOT

ROS = ROOT / "q2r2_control" / "ros"
ROS_PACKAGES = {
    *("rclpy", "launch", "launch_ros", "ament_index_python", "domain_coordinator", "quest2ros"),
    *("rcl_interfaces", "rosgraph_msgs", "builtin_interfaces", "action_msgs", "std_srvs", "tf2_msgs"),
    *("control_msgs", "diagnostic_msgs", "geometry_msgs", "sensor_msgs", "std_msgs", "trajectory_msgs"),
    "visualization_msgs",
}
INTERFACES = {file.parent.name for file in ROS.glob("interfaces/*/package.xml")}


def test_every_package_that_the_nodes_import_is_looked_for() -> None:
    imported = {
        name.split(".")[0]
        for file in ROS.rglob("*.py")
        for part in ast.walk(ast.parse(file.read_text()))
        for name in ([part.module or ""] if isinstance(part, ast.ImportFrom) else [])
    }
    assert (imported & ROS_PACKAGES) - INTERFACES == set(PACKAGES)


@pytest.mark.parametrize(
    ("variables", "reaches"),
    [
        ({}, "SUBNET"),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", "ROS_STATIC_PEERS": "10.0.0.2"}, "OFF, and 10.0.0.2"),
        ({"ROS_LOCALHOST_ONLY": "1"}, "this machine only"),
    ],
)
def test_it_says_whom_nodes_find(variables: dict[str, str], reaches: str) -> None:
    facts, findings = examine_environment(variables | {"ROS_DOMAIN_ID": "-1"})  # so that no node is tried
    assert facts["reaches"].startswith(reaches)
    assert any("ROS_DOMAIN_ID is '-1'" in finding.what and finding.stops_arms for finding in findings)
