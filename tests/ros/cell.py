"""A cell of ROS nodes from the view of tests, which read joint states, transforms and states, and send targets."""

from __future__ import annotations

import json
import threading
import time
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import yaml
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from q2r2_control import Robot
from q2r2_control.robot.compose import WORLD
from q2r2_control.ros.base_node import COMMAND_QOS, LATCHED_QOS, STREAM_QOS
from q2r2_control.ros.bridge.frames import FrameTree, read_transforms
from q2r2_control.ros.bridge.messages import stamped_pose
from q2r2_control.types import Array
from tests.ros.processes import CONFIG, ROOT, Processes, RosProcess, call, wait_until

RATE = 100.0  # Rate of targets [Hz].
NODE_RATE = 125.0  # The rate is half of the nodes' default, because many processes share a test machine [Hz].
STILL = 2e-3  # Largest motion of joints at rest [rad].
# The timeout is longer than the default, so that other load on the machine does not look like a fault.
PATIENT = ("joint_state_timeout:=0.5", "target_timeout:=0.5", "listener_timeout:=1.0")


class Cell:
    def __init__(
        self, node: Any, robot: Robot, *processes: RosProcess, targets: str = "/q2r2/{arm}/target_frame"
    ) -> None:
        self.node, self.robot, self.processes = node, robot, processes
        self.joints = JointRecorder(node, robot)
        self.frames = FrameTree()
        self.parents: dict[str, str] = {}  # The parent of each frame on /tf and /tf_static.
        self.states: dict[str, dict[str, Any]] = {}
        self.streams: list[Stream] = []
        self.call = partial(call, node)
        self._publishers = {
            arm: node.create_publisher(PoseStamped, targets.format(arm=arm), COMMAND_QOS) for arm in robot.arms
        }
        for topic, qos in (("/tf", STREAM_QOS), ("/tf_static", LATCHED_QOS)):
            node.create_subscription(TFMessage, topic, self._on_transforms, qos)
        for name in ("mujoco_robot", "cartesian_controller"):
            node.create_subscription(String, f"/{name}/state", partial(self._on_state, name), 10)

    def _on_transforms(self, message: TFMessage) -> None:
        self.parents |= {one.child_frame_id: one.header.frame_id for one in message.transforms}
        for read in read_transforms(serialize_message(message)):
            self.frames.set(read, time.monotonic())

    def _on_state(self, name: str, message: String) -> None:
        self.states[name] = json.loads(message.data)

    @property
    def q(self) -> Array:
        return self.joints.q

    @property
    def postures(self) -> list[Array]:
        return [state.q for state in self.joints.states[:]]

    def forget(self) -> None:
        """Drop all joint states, and wait for the next one."""
        self.joints.states.clear()
        wait_until(lambda: self.joints.states, "joint states come")

    def tool(self, arm: str) -> pin.SE3:
        tool = self.find_tool(arm)
        assert tool is not None
        return tool

    def find_tool(self, arm: str) -> pin.SE3 | None:
        """Return the tool's pose from /tf, or None while it is not known."""
        placement = self.frames.find(self.robot.arms[arm].tool_frame, WORLD)
        return None if placement is None else placement.pose

    def state(self, key: str, name: str = "cartesian_controller") -> Any:
        return self.states.get(name, {}).get(key)

    def send(self, arm: str, target: pin.SE3 | PoseStamped) -> None:
        message = target if isinstance(target, PoseStamped) else stamped_pose(target, WORLD, 0.0)
        self._publishers[arm].publish(message)

    def wait_until_active(self) -> None:
        wait_until(lambda: self.state("phase") == "active", "the controller is active", lambda: self.states)
        wait_until(lambda: all(p.get_subscription_count() for p in self._publishers.values()), "targets have listeners")
        wait_until(lambda: all(self.find_tool(arm) is not None for arm in self.robot.arms), "tools are on /tf")

    def engage(self, *arms: str) -> Stream:
        """Begin a stream of targets at the tool of each arm, and wait until the arms follow."""
        stream = Stream(self, {arm: self.tool(arm) for arm in arms})
        follows = lambda: all(self.state(f"{arm}_state") == "following" for arm in arms)  # noqa: E731
        wait_until(follows, f"{arms} follow", lambda: self.states)
        return stream

    def stop_and_reset(self, at_home: bool = False) -> None:
        """Stop and reset the controller. With ``at_home``, the simulation puts the arms at home meanwhile."""
        assert self.call("/cartesian_controller/stop").success
        wait_until(lambda: self.state("phase") == "stopped", "the controller is stopped")
        if at_home:
            self.call("/mujoco_robot/reset")
            # The controller begins at the posture of the newest joint state, which may be older than the reset.
            for arm in self.robot.arms:
                self.wait_until_there(arm, self.robot.tool_pose(self.robot.home, arm), 2e-3)
        assert self.call("/cartesian_controller/reset").success

    def wait_until_there(self, arm: str, goal: pin.SE3, within: float) -> None:
        """Wait until the tool of ``arm`` is less than ``within`` [m] away from ``goal``."""

        def there() -> bool:
            tool = self.find_tool(arm)
            return tool is not None and float(np.linalg.norm(tool.translation - goal.translation)) < within

        wait_until(there, f"the {arm} tool is there")

    def end_streams(self) -> None:
        while self.streams:
            self.streams.pop().end()


class Stream:
    """A thread that steadily sends the targets of some arms until :meth:`end`. Tests may change ``poses``."""

    def __init__(self, cell: Cell, poses: dict[str, pin.SE3]) -> None:
        self.poses = dict(poses)
        self._cell, self._ended = cell, threading.Event()
        cell.streams.append(self)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def move(self, arm: str, by: tuple[float, float, float], speed: float = 0.25) -> None:
        """Move an arm's target straight by ``by`` [m] at ``speed`` [m/s]. Return when the target has arrived."""
        start, way = self.poses[arm], np.array(by)
        steps = max(int(np.linalg.norm(way) / speed * RATE), 1)
        for step in range(1, steps + 1):
            self.poses[arm] = pin.SE3(start.rotation, start.translation + way * step / steps)
            time.sleep(1.0 / RATE)

    def end(self) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended.wait(1.0 / RATE):
            for arm, pose in self.poses.items():
                self._cell.send(arm, pose)


def start_robot(processes: Processes, *parameters: str, config: str = CONFIG) -> RosProcess:
    return processes.start_node("mujoco_robot", f"config:={config}", f"rate:={NODE_RATE}", *parameters)


def start_controller(processes: Processes, *parameters: str, config: str = CONFIG, node: str = "") -> RosProcess:
    given = (f"config:={config}", f"rate:={NODE_RATE}", *parameters)
    return processes.start_node("cartesian_controller", *given, node=node)


def changed_cell(folder: Path, **sections: dict[str, Any]) -> str:
    cell = yaml.safe_load((ROOT / CONFIG).read_text())
    for section, keys in sections.items():
        cell[section] = cell[section] | keys
    file = folder / "changed.yaml"
    file.write_text(yaml.safe_dump(cell))
    return str(file)


# On a machine with other load, torques through ROS arrive some periods late. With the default stiffness, the impedance
# is stable up to a delay of 8 ms, which is one period here. With this stiffness it is stable up to several periods.
SOFT = {"translational_stiffness": 300.0, "rotational_stiffness": 20.0, "nullspace_stiffness": 10.0}


def shifted(pose: pin.SE3, *by: float) -> pin.SE3:
    return pin.SE3(pose.rotation, pose.translation + np.array(by))


# Speed of 3 % of a joint's limit [rad/s]. A slower arm still settles, but no longer follows.
SLOW = 0.05
REST = 0.01  # A joint that is slower than this rests [rad/s].
REST_TIME = 0.3  # Time for which joints have to be slower than ``REST`` [s].
# The window is shorter than the duration of a jump. It is longer than the time in which the process of a robot that got
# no processor time catches up [s].
SPEED_WINDOW = 0.2


class Joints(NamedTuple):
    t: float  # Time of receipt of the message, on this machine's steady clock [s].
    q: Array
    v: Array
    stamp: float  # Stamp of the message [s].


class JointRecorder:
    def __init__(self, node: Any, robot: Robot) -> None:
        self.states: list[Joints] = []
        self._robot = robot
        node.create_subscription(JointState, "/joint_states", self._on_joint_state, 100)

    def _on_joint_state(self, message: Any) -> None:
        """Ignore a state without all joints of the arms."""
        if set(message.name) >= set(self._robot.joint_names):
            order = [message.name.index(name) for name in self._robot.joint_names]
            stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            q, v = np.array(message.position)[order], np.array(message.velocity)
            self.states.append(Joints(time.monotonic(), q, v[order] if len(v) else np.zeros(len(q)), stamp))

    @property
    def q(self) -> Array:
        return self.states[-1].q

    def tool(self, arm: str) -> pin.SE3:
        return self._robot.tool_pose(self.q, arm)

    def since(self, t: float) -> list[Joints]:
        states = self.states[:]  # The other thread appends to the list.
        return states[bisect_right(states, t, key=lambda state: state.t) :]

    def speeds(self, duration: float) -> Array:
        """Return the largest speed of each joint in the last ``duration`` [s]."""
        recent = self.since(time.monotonic() - duration)
        speeds = np.abs([state.v for state in recent] or [np.zeros(self._robot.model.nv)])
        return np.asarray(speeds.max(axis=0), dtype=float)

    def fastest(self, since: float) -> float:
        """Return the largest mean speed of a joint in a window of ``SPEED_WINDOW`` after ``since`` [rad/s]."""
        states, first, fastest = self.since(since), 0, 0.0
        for state in states:
            while state.stamp - states[first].stamp > SPEED_WINDOW:
                change = float(np.abs(state.q - states[first].q).max())
                fastest = max(fastest, change / (state.stamp - states[first].stamp))
                first += 1
        return fastest

    def farthest_from(self, posture: Array, since: float) -> float:
        return max(float(np.abs(state.q - posture).max()) for state in self.since(since))

    def tool_farthest_from(self, posture: Array, since: float) -> float:
        return max(self._tool_motion(arm, posture, self.since(since)) for arm in self._robot.arms)

    def wait_for_rest(self) -> Array:
        """Wait until no joint has moved for a while, and return the positions [rad]."""

        def rests() -> bool:
            recent = [state.q for state in self.since(time.monotonic() - 0.4)]
            return len(recent) >= 10 and float(np.ptp(recent, axis=0).max()) < 5e-4

        wait_until(rests, "the arms are at rest")
        return self.q

    def stop_after(self, fault: float) -> tuple[float, float]:
        """Wait until all joints rest after a fault at the time ``fault`` [s].

        Return the largest joint speed just before the fault [rad/s], and the time from the fault until all joints are
        slower than ``SLOW`` [s].
        """

        def last(speed: float) -> float:
            """Return the last time at which a joint was faster than ``speed`` [rad/s]."""
            return max((state.t for state in self.since(fault) if np.abs(state.v).max() > speed), default=fault)

        wait_until(lambda: self.states[-1].t - last(REST) > REST_TIME, "all joints rest")
        before = [state for state in self.states if state.t <= fault][-1]
        return float(np.abs(before.v).max()), last(SLOW) - fault

    @contextmanager
    def tools_rest(self, within: float, what: str) -> Iterator[None]:
        """Assert, at each joint state in the ``with`` block, that no tool has moved farther than ``within`` [m]."""
        first = self.states[-1]
        yield
        for arm in self._robot.arms:
            moved = self._tool_motion(arm, first.q, self.since(first.t))
            assert moved <= within, f"{arm} moved by {moved:.4f} m while {what}"

    def _tool_motion(self, arm: str, posture: Array, states: list[Joints]) -> float:
        start = self._robot.tool_pose(posture, arm).translation
        tools = [self._robot.tool_pose(state.q, arm).translation for state in states]
        return max((float(np.linalg.norm(tool - start)) for tool in tools), default=0.0)
