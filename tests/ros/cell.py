"""A cell of ROS nodes as tests see and move it: joint states, transforms, states in; targets and services out."""

from __future__ import annotations

import json
import threading
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import yaml
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from q2r2_control import Robot
from q2r2_control.robot.compose import WORLD
from q2r2_control.ros.base_node import COMMAND_QOS, LATCHED_QOS, STREAM_QOS
from q2r2_control.ros.bridge.frames import FrameTree, read_transforms
from q2r2_control.ros.bridge.messages import pose_message
from q2r2_control.types import Array
from tests.ros import waiting
from tests.ros.joint_recorder import JointRecorder
from tests.ros.processes import CONFIG, PATIENCE, ROOT, Processes, RosProcess
from tests.ros.waiting import wait_until

RATE = 100.0  # of targets [Hz]
NODE_RATE = 125.0  # half of the nodes' default, since many processes share a test machine [Hz]
_BEGINS = 5.0  # how long a stream of targets may take to be followed [s]
_GAP = 0.7  # without targets, after which another stream begins: longer than PATIENT's target_timeout [s]
STILL = 2e-3  # how far joints at rest may move [rad]
# Longer than by default, so that other load on the machine does not look like a fault.
PATIENT = ("joint_state_timeout:=0.5", "target_timeout:=0.5", "listener_timeout:=1.0")


class Cell:
    """Listens to a cell, and streams targets to it."""

    def __init__(
        self, node: Any, robot: Robot, *processes: RosProcess, targets: str = "/q2r2/{arm}/target_frame"
    ) -> None:
        self.node, self.robot, self.processes = node, robot, processes
        self.joints = JointRecorder(robot)
        self.frames = FrameTree()
        self.parents: dict[str, str] = {}  # of each frame on /tf and /tf_static
        self.states: dict[str, dict[str, Any]] = {}
        self._publishers = {
            arm: node.create_publisher(PoseStamped, targets.format(arm=arm), COMMAND_QOS) for arm in robot.arms
        }
        self.joints.subscribe(node)
        for topic, qos in (("/tf", STREAM_QOS), ("/tf_static", LATCHED_QOS)):
            node.create_subscription(TFMessage, topic, self._on_transforms, qos)
        for name in ("mujoco_robot", "cartesian_controller"):
            node.create_subscription(String, f"/{name}/state", partial(self._on_state, name), 10)

    def _on_transforms(self, message: TFMessage) -> None:
        for transform in message.transforms:
            self.parents[transform.child_frame_id] = transform.header.frame_id
        for read in read_transforms(serialize_message(message)):
            self.frames.set(read, time.monotonic())

    def _on_state(self, name: str, message: String) -> None:
        self.states[name] = json.loads(message.data)

    @property
    def q(self) -> Array:
        """The newest joint positions [rad]."""
        return self.joints.q

    @property
    def postures(self) -> list[Array]:
        """All joint positions since :meth:`forget` [rad]."""
        return [state.q for state in self.joints.states[:]]

    def forget(self) -> None:
        """Drop all joint states, and wait for the next one."""
        self.joints.states.clear()
        wait_until(lambda: self.joints.states, "joint states come")

    def tool(self, arm: str) -> pin.SE3:
        """An arm's tool, from /tf."""
        tool = self.find_tool(arm)
        assert tool is not None
        return tool

    def find_tool(self, arm: str) -> pin.SE3 | None:
        """The same; None as long as it is not known."""
        placement = self.frames.find(self.robot.arms[arm].tool_frame, WORLD)
        return None if placement is None else placement.pose

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
        """The response of a service, see :func:`waiting.call`."""
        return waiting.call(self.node, service, request)

    def wait_until_active(self) -> None:
        """Wait until the arms can be moved."""
        wait_until(lambda: self.state("phase") == "active", "the controller is active", lambda: self.states)
        wait_until(lambda: all(p.get_subscription_count() for p in self._publishers.values()), "targets have listeners")
        wait_until(lambda: all(self.find_tool(arm) is not None for arm in self.robot.arms), "tools are on /tf")

    def engage(self, *arms: str) -> Stream:
        """Begin streams of targets at the tools, anew where a stall of this machine ended one that had begun."""
        deadline = time.monotonic() + PATIENCE
        while True:
            stream = Stream(self, {arm: self.tool(arm) for arm in arms})
            patience = time.monotonic() + _BEGINS
            while time.monotonic() < min(patience, deadline):
                if all(self.state(f"{arm}_state") == "following" for arm in arms):
                    return stream
                time.sleep(0.01)
            stream.end()  # or it would pull at the arms in the tests after this one
            assert time.monotonic() < deadline, f"{arms} do not follow: {self.states}"
            time.sleep(_GAP)

    def wait_until_home(self) -> None:
        """Wait until /tf tells of tools at home: transforms of before a reset may come late."""

        def at_home(arm: str) -> bool:
            home = self.robot.tool_pose(self.robot.home, arm).translation
            there = self.find_tool(arm)
            return there is not None and float(np.linalg.norm(there.translation - home)) < 2e-3

        wait_until(lambda: all(map(at_home, self.robot.arms)), "the tools are at home")


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


def start_robot(processes: Processes, *parameters: str, config: str = CONFIG) -> RosProcess:
    """Start the simulated robot."""
    return processes.start_node("mujoco_robot", f"config:={config}", f"rate:={NODE_RATE}", *parameters)


def start_controller(processes: Processes, *parameters: str, config: str = CONFIG, **environment: str) -> RosProcess:
    """Start the built-in controller."""
    given = (f"config:={config}", f"rate:={NODE_RATE}", *parameters)
    return processes.start_node("cartesian_controller", *given, **environment)


def changed_cell(folder: Path, **sections: dict[str, Any]) -> str:
    """File of the shipped cell with keys of some of its sections changed."""
    cell = yaml.safe_load((ROOT / CONFIG).read_text())
    for section, keys in sections.items():
        cell[section] = cell[section] | keys
    file = folder / "changed.yaml"
    file.write_text(yaml.safe_dump(cell))
    return str(file)


# Torques through ROS arrive some periods late on a machine with other load. Springs of the default stiffness bear 8 ms
# of delay, which is one period here; these bear several.
SOFT = {"translational_stiffness": 300.0, "rotational_stiffness": 20.0, "nullspace_stiffness": 10.0}


def shifted(pose: pin.SE3, x: float, y: float, z: float) -> pin.SE3:
    """A pose moved along the world's axes [m]."""
    return pin.SE3(pose.rotation, pose.translation + np.array([x, y, z]))
