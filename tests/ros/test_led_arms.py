"""Output none: another controller moves the arms after the safe targets, and its elbows go where they like."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from q2r2_control import Robot
from q2r2_control.types import Array
from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import ROOT, Processes
from tests.ros.waiting import States, wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)

import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from tests.ros.cell import CONFIG

PERIOD = 0.005  # of the joint states [s]
SPEED = 0.3  # of the elbow's swing, in the norm of the joints' velocities [rad/s]
FREE, TOO_FAR = 0.7, 1.5  # how far the elbow swings at first and then, a post being in its way [rad]
POST, RADIUS = 2.6, 0.04  # where the post is on the elbow's way, and its own radius [rad], [m]
MIN_DISTANCE, TOLERANCE = 0.02, 0.01  # [m]


def swung(robot: Robot, way: float) -> list[Array]:
    """Postures from home on, the left elbow swinging inwards by ``way`` [rad] while no tool moves."""
    data, arm, q = robot.model.createData(), robot.arms["left"], robot.home.copy()
    tool, step = robot.tool_pose(q, "left"), SPEED * PERIOD
    postures, last = [q.copy()], np.eye(7)[2]
    for _ in range(round(way / step)):
        J = pin.computeFrameJacobian(robot.model, data, q, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)[:, arm.joints]
        free = np.linalg.svd(J)[2][-1]
        last = free if free @ last > 0.0 else -free
        pose = robot.tool_pose(q, "left")
        back = np.r_[tool.translation - pose.translation, pin.log3(tool.rotation @ pose.rotation.T)]
        q[arm.joints] += step * last + np.linalg.pinv(J) @ back
        postures.append(q.copy())
    return postures


class Elbow:
    """Arms that hold their tools and swing an elbow: what a controller with a posture of its own makes of them."""

    def __init__(self, node: Node, robot: Robot, postures: list[Array]) -> None:
        self._names, self._postures = list(robot.joint_names), postures
        self._publisher = node.create_publisher(JointState, "/joint_states", 10)
        self._at, self._until = 0, 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def q(self) -> Array:
        return self._postures[self._at]

    @property
    def arrived(self) -> bool:
        return self._at == self._until

    def swing(self, way: float) -> None:
        self._until = min(round(way / (SPEED * PERIOD)), len(self._postures) - 1)

    def end(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(PERIOD):
            self._at = min(self._at + 1, self._until)
            self._publisher.publish(JointState(name=self._names, position=self.q.tolist()))


@pytest.fixture
def config(robot: Robot, tmp_path: Path) -> Path:
    """The cell with a post that the left elbow runs into, but not the reference's."""
    q = swung(robot, POST)[-1]
    data = robot.model.createData()
    pin.forwardKinematics(robot.model, data, q)
    elbow = data.oMi[robot.model.getJointId("left_A4")].translation
    cell = yaml.safe_load((ROOT / CONFIG).read_text())
    cell["obstacles"]["post"] = {"shape": "sphere", "size": [RADIUS], "position": elbow.tolist()}
    path = tmp_path / "post.yaml"
    path.write_text(yaml.safe_dump(cell))
    return path


@pytest.fixture
def elbow(node: Any, robot: Robot) -> Iterator[Elbow]:
    made = Elbow(node, robot, swung(robot, TOO_FAR))
    yield made
    made.end()


def test_elbows_may_swing_while_the_tools_stay_until_what_is_measured_comes_too_close(
    node: Any, robot: Robot, config: Path, elbow: Elbow, processes: Processes
) -> None:
    states = States(node, "cartesian_controller")
    safe: list[PoseStamped] = []
    node.create_subscription(PoseStamped, "/cartesian_controller/safe_target/left", safe.append, 10)
    controller = processes.start_module(
        "q2r2_control.ros.nodes.cartesian_controller",
        *("--ros-args", "-p", f"config:={config}", "-p", "output:=none"),
        *("-p", f"distance_tolerance:={TOLERANCE}", "-p", "joint_state_timeout:=0.5"),
    )
    states.wait_for("active")
    wait_until(lambda: safe, "safe targets come")

    elbow.swing(FREE)
    wait_until(lambda: elbow.arrived, "the elbow has swung")
    time.sleep(1.0)  # what stops arms that deviate takes 0.5 s
    assert states.wait_for("active")["phase"] == "active"
    assert np.abs(elbow.q - robot.home).max() > 0.5
    position = safe[-1].pose.position
    tool = robot.tool_pose(robot.home, "left").translation
    assert np.linalg.norm(np.array([position.x, position.y, position.z]) - tool) < 1e-3

    elbow.swing(TOO_FAR)
    state = states.wait_for("measured: ")
    assert state["level"] == "error"
    wait_until(lambda: states.wait_for("measured: ")["phase"] == "stopped", "the reference is at rest")
    pair, distance = state["message"].split(" are ")
    assert pair.startswith("measured: left_link_")
    assert pair.endswith("|post_0")
    assert MIN_DISTANCE - TOLERANCE - 0.01 < float(distance.split(" m")[0]) <= MIN_DISTANCE - TOLERANCE
    count = len(safe)
    time.sleep(0.3)
    assert len(safe) <= count + 1
    assert controller.output.count("measured: ") == 1
