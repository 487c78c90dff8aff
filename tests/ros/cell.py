"""What tests see and do of a cell of ROS nodes: joint states, transforms, diagnostics in; targets and services out."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from q2r2_control import Robot
from q2r2_control.ros.base_node import COMMAND_QOS
from q2r2_control.ros.bridge.messages import pose_message
from q2r2_control.types import Array
from tests.ros.processes import PATIENCE, Processes, RosProcess

CONFIG = "config/dual_iiwa7.yaml"
RATE = 100.0  # of targets [Hz]
NODE_RATE = 125.0  # of those below, half of their own, since many processes share a test machine [Hz]
BUSY = ("mujoco_robot", "cartesian_controller")
STILL = 2e-3  # how far joints at rest may move [rad]
# Longer than by default, so that a machine that is busy elsewhere does not look like a fault.
PATIENT = ("-p", "joint_state_timeout:=0.5", "-p", "target_timeout:=0.5", "-p", "listener_timeout:=1.0")


@dataclass(frozen=True)
class Measured:
    """Joint positions of all arms, and when they came [s]."""

    q: Array
    t: float


class Cell:
    """Listens to a cell, and streams targets to it."""

    def __init__(
        self, node: Any, robot: Robot, *processes: RosProcess, targets: str = "/q2r2/{arm}/target_frame"
    ) -> None:
        self.node, self.robot, self.processes = node, robot, processes
        self.measured: list[Measured] = []
        self.tools: dict[str, pin.SE3] = {}
        self.states: dict[str, dict[str, Any]] = {}
        self._publishers = {
            arm: node.create_publisher(PoseStamped, targets.format(arm=arm), COMMAND_QOS) for arm in robot.arms
        }
        node.create_subscription(JointState, "/joint_states", self._on_joint_state, 100)
        node.create_subscription(TFMessage, "/tf", self._on_transforms, 100)
        for name in ("mujoco_robot", "cartesian_controller"):
            node.create_subscription(String, f"/{name}/state", partial(self._on_state, name), 10)

    def _on_joint_state(self, message: JointState) -> None:
        place = {name: index for index, name in enumerate(message.name)}
        if all(name in place for name in self.robot.joint_names):
            q = np.array([message.position[place[name]] for name in self.robot.joint_names])
            self.measured.append(Measured(q, time.monotonic()))

    def _on_transforms(self, message: TFMessage) -> None:
        for transform in message.transforms:
            p, r = transform.transform.translation, transform.transform.rotation
            self.tools[transform.child_frame_id] = pin.SE3(
                pin.Quaternion(r.w, r.x, r.y, r.z).toRotationMatrix(), np.array([p.x, p.y, p.z])
            )

    def _on_state(self, name: str, message: String) -> None:
        self.states[name] = json.loads(message.data)

    @property
    def q(self) -> Array:
        """The newest joint positions."""
        return self.measured[-1].q

    def tool(self, arm: str) -> pin.SE3:
        """An arm's tool, from /tf."""
        return self.tools[self.robot.arms[arm].tool_frame]

    def state(self, key: str, name: str = "cartesian_controller") -> Any:
        """The newest value in a node's state."""
        return self.states.get(name, {}).get(key)

    def send(self, arm: str, pose: pin.SE3, frame: str = "world") -> None:
        """One target."""
        message = PoseStamped(pose=pose_message(pose))
        message.header.frame_id = frame
        self._publishers[arm].publish(message)

    def send_message(self, arm: str, message: PoseStamped) -> None:
        """One target as it is."""
        self._publishers[arm].publish(message)

    def call(self, service: str, request: Any = None) -> Any:
        """Call a Trigger service, or a SetBool one with its request; the response."""
        return call(self.node, service, request)

    def wait_until_active(self) -> None:
        """Until the arms can be moved."""
        wait(lambda: self.state("phase") == "active", "the controller is active")
        wait(lambda: all(p.get_subscription_count() for p in self._publishers.values()), "targets are listened to")
        wait(lambda: all(arm.tool_frame in self.tools for arm in self.robot.arms.values()), "tools are on /tf")

    def engage(self, *arms: str) -> Stream:
        """Begin streams of targets at the tools."""
        stream = Stream(self, {arm: self.tool(arm) for arm in arms})
        wait(lambda: all(self.state(f"{arm}_state") == "following" for arm in arms), f"{arms} follow")
        return stream


class Stream:
    """Sends the targets of some arms steadily until it is ended; ``poses`` may be replaced."""

    def __init__(self, cell: Cell, poses: dict[str, pin.SE3]) -> None:
        self.poses = dict(poses)
        self._cell, self._ended = cell, threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def move(self, arm: str, by: tuple[float, float, float], speed: float = 0.25) -> None:
        """Move an arm's target on a straight line [m], [m/s]; returns when it has arrived."""
        start, way = self.poses[arm], np.array(by)
        steps = max(int(np.linalg.norm(way) / speed * RATE), 1)
        for step in range(1, steps + 1):
            self.poses[arm] = pin.SE3(start.rotation, start.translation + way * step / steps)
            time.sleep(1.0 / RATE)

    def end(self) -> None:
        """No more targets."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(1.0 / RATE):
            for arm, pose in self.poses.items():
                self._cell.send(arm, pose)


def call(node: Any, service: str, request: Any = None) -> Any:
    """Call a Trigger service, or a SetBool one with its request; the response."""
    client = node.create_client(Trigger if request is None else SetBool, service)
    try:
        assert client.wait_for_service(PATIENCE), service
        future = client.call_async(Trigger.Request() if request is None else request)
        wait(future.done, f"{service} answers")
        return future.result()
    finally:
        node.destroy_client(client)


def start(processes: Processes, name: str, *arguments: str, **environment: str) -> RosProcess:
    """Start a node of the cell."""
    given = parameters(f"config:={CONFIG}", *([f"rate:={NODE_RATE}"] if name in BUSY else []))
    return processes.start_module(f"q2r2_control.ros.nodes.{name}", "--ros-args", *given, *arguments, **environment)


def parameters(*given: str) -> list[str]:
    """Arguments that set parameters, each as ``name:=value``."""
    return [part for parameter in given for part in ("-p", parameter)]


def shifted(pose: pin.SE3, x: float, y: float, z: float) -> pin.SE3:
    """A pose moved along the world's axes [m]."""
    return pin.SE3(pose.rotation, pose.translation + np.array([x, y, z]))


def at_rest(cell: Cell) -> Array:
    """Joint positions once they no longer change."""
    wait(lambda: len(cell.measured) > 60 and moved(cell, 50) < 5e-4, "the arms are at rest")
    return cell.q


def moved(cell: Cell, count: int) -> float:
    """How far any joint has moved in the last so many joint states [rad]."""
    return float(np.ptp([measured.q for measured in cell.measured[-count:]], axis=0).max())


def wait(condition: Callable[[], Any], what: str, timeout: float = PATIENCE) -> None:
    """Until ``condition`` holds; fails when time runs out."""
    deadline = time.monotonic() + timeout
    while not condition():
        assert time.monotonic() < deadline, f"not within {timeout:g} s: {what}"
        time.sleep(0.01)
