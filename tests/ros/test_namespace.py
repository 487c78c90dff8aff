"""All topics and services of a set are in the set's namespace, so that two sets in one domain are independent."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.ros.conftest import need_ros
from tests.ros.processes import wait_until

need_ros()

import rclpy

from q2r2_control.ros.nodes.arm_controllers import LeftArmController
from q2r2_control.ros.nodes.cartesian_controller import CartesianControllerNode
from q2r2_control.ros.nodes.mujoco_robot import MujocoRobot
from q2r2_control.ros.nodes.recorder import RecorderNode
from q2r2_control.ros.nodes.simulation_input import SimulationInput
from q2r2_control.ros.nodes.tcp_endpoint import TcpEndpoint

NAMESPACE = "/cell"
OF_ROS = {"/rosout", "/parameter_events", "/clock"}  # rclpy itself makes these topics.
NODES = {
    "mujoco_robot": MujocoRobot,
    "cartesian_controller": CartesianControllerNode,
    "left_arm_controller": LeftArmController,
    "simulation_input": SimulationInput,
    "tcp_endpoint": TcpEndpoint,
    "recorder": RecorderNode,
}


@pytest.fixture
def in_namespace(domain: int, tmp_path: Any) -> Iterator[None]:
    given = ["-r", f"__ns:={NAMESPACE}", "-p", f"folder:={tmp_path}", "-p", "port:=0"]
    rclpy.init(args=["--ros-args", *given], domain_id=domain)
    yield
    rclpy.try_shutdown()


def names_of(node: Any) -> set[str]:
    """Return topics and services of a node, as the graph knows them."""
    of_node = node.get_name(), node.get_namespace()
    found = [
        *node.get_publisher_names_and_types_by_node(*of_node),
        *node.get_subscriber_names_and_types_by_node(*of_node),
        *node.get_service_names_and_types_by_node(*of_node),
        *node.get_client_names_and_types_by_node(*of_node),
    ]
    return {name for name, _ in found} - OF_ROS


@pytest.mark.parametrize("name", NODES)
@pytest.mark.usefixtures("in_namespace")
def test_a_node_in_a_namespace_has_all_its_topics_and_services_in_this_namespace(name: str) -> None:
    node = NODES[name]()
    try:
        state = f"{NAMESPACE}/{node.get_name()}/state"
        wait_until(lambda: state in names_of(node), "the graph knows the node")
        assert {one for one in names_of(node) if not one.startswith(f"{NAMESPACE}/")} == set()
    finally:
        node.close()
        node.destroy_node()
