"""A hand and a robot for one arm controller: what the headset sends, where the tool is, and all that comes back."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import PoseStamped, TransformStamped
from quest2ros.msg import OVR2ROSHapticFeedback, OVR2ROSInputs
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from q2r2_control.ros.base_node import COMMAND_QOS, STREAM_QOS
from q2r2_control.ros.bridge.messages import pose_of, stamped_pose, transform_message
from tests.ros.processes import PATIENCE, Processes, RosProcess

PERIOD = 1.0 / 72.0  # of the hand's messages, as a Quest sends them, and of /tf [s]
HAND = pin.SE3(pin.exp3(np.array([0.2, -0.4, 0.6])), np.array([0.3, 0.1, 1.0]))
TOOL = pin.SE3(pin.exp3(np.array([3.0, 0.2, 0.1])), np.array([0.5, 0.25, 0.38]))
# A busy machine must not look like a fault: only the tests of these timeouts leave them as they are.
PATIENT = {"teleop.gate.timeout": 1.0, "tool_timeout": 1.0, "link_timeout": 3.0, "listener_timeout": 1.0}


class ArmRig:
    """Plays the hand ``hand`` and the robot of the arm ``arm`` on a node that a thread spins.

    The tool follows the targets at once while ``follows``; it is told on /tf while ``tells_tool``.
    """

    def __init__(
        self,
        node: Any,
        arm: str = "left",
        hand: str | None = None,
        topic: str | None = None,
        tool_frame: str | None = None,
        robot: str = "q2r2",
    ) -> None:
        hand = hand or arm
        self.arm, self.node = arm, node
        self.hand, self.tool = HAND, TOOL
        self.lower = self.upper = False
        self.sends_hand = self.tells_tool = self.follows = True
        self.targets: list[PoseStamped] = []
        self.state: dict[str, Any] = {}
        self.levels: Counter[str] = Counter()
        self.pulses: list[tuple[float, float]] = []
        self._frame = tool_frame or f"{arm}_tool_frame"
        self._made = [
            node.create_publisher(PoseStamped, f"q2r_{hand}_hand_pose", STREAM_QOS),
            node.create_publisher(OVR2ROSInputs, f"q2r_{hand}_hand_inputs", STREAM_QOS),
            node.create_publisher(TFMessage, "/tf", 100),
        ]
        self._listens = [
            node.create_subscription(PoseStamped, topic or f"/q2r2/{arm}/target_frame", self._on_target, COMMAND_QOS),
            node.create_subscription(String, f"/{arm}_{robot}_arm_controller/state", self._on_state, 10),
            node.create_subscription(
                OVR2ROSHapticFeedback,
                f"q2r_{hand}_hand_haptic_feedback",
                lambda message: self.pulses.append((round(message.frequency, 3), round(message.amplitude, 3))),
                COMMAND_QOS,
            ),
        ]
        self._timer = node.create_timer(PERIOD, self._send)

    def start(self, processes: Processes, parameters: dict[str, Any] | None = None, module: str = "") -> RosProcess:
        """Start the arm's controller; returns when it and the rig know each other."""
        arguments = [f"-p {name}:={value}" for name, value in (PATIENT | (parameters or {})).items()]
        module = module or f"q2r2_control.ros.nodes.{self.arm}_arm_controller"
        process = processes.start_module(module, "--ros-args", *" ".join(arguments).split())
        self.wait(lambda: self.state.get("hand_age") is not None, "the controller sees the hand")
        return process

    def wait(self, condition: Callable[[], Any], what: str, timeout: float = PATIENCE) -> None:
        """Return once ``condition`` holds."""
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, f"waited {timeout:g} s until {what}; state {self.state}"
            time.sleep(0.005)

    def press(self, button: str = "lower") -> None:
        """A press that is no chord."""
        setattr(self, button, True)
        time.sleep(0.2)
        setattr(self, button, False)
        time.sleep(0.1)

    def engage(self) -> None:
        """Press until the arm follows; what was sent before does not count."""
        self.wait(lambda: self.state.get("level") == "ok", "nothing keeps the arm from being engaged")
        self.press()
        self.wait(lambda: self.state.get("engaged"), "the arm is engaged")

    def pause(self) -> None:
        self.press()
        self.wait(lambda: self.state.get("state") == "paused", "the arm is paused")

    def move(self, by: tuple[float, float, float], duration: float = 0.4, turn: float = 0.0) -> None:
        """Move the hand evenly, turning about z."""
        start, began = self.hand, time.monotonic()
        while (share := min((time.monotonic() - began) / duration, 1.0)) < 1.0:
            self._place(start, np.array(by), share, turn)
            time.sleep(PERIOD / 2)
        self._place(start, np.array(by), 1.0, turn)

    def newest(self) -> pin.SE3:
        """The last target."""
        pose = pose_of(self.targets[-1].pose)
        assert pose is not None
        return pose

    def wait_for_rest(self) -> pin.SE3:
        """The target once it stands still, or no more comes."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            before = self.newest()
            time.sleep(0.3)
            if before.isApprox(self.newest(), 1e-6):
                return self.newest()
        raise AssertionError("the target does not come to rest")

    def _place(self, start: pin.SE3, by: Any, share: float, turn: float) -> None:
        self.hand = pin.SE3(
            pin.exp3(np.array([0.0, 0.0, share * turn])) @ start.rotation, start.translation + share * by
        )

    def _send(self) -> None:
        now = self.node.get_clock().now().nanoseconds * 1e-9
        pose, inputs, tf = self._made
        if self.sends_hand:
            pose.publish(stamped_pose(self.hand, "", now))
            inputs.publish(OVR2ROSInputs(button_upper=self.upper, button_lower=self.lower))
        if self.tells_tool:
            tf.publish(TFMessage(transforms=[stamped_transform("world", self._frame, self.tool)]))

    def _on_target(self, message: PoseStamped) -> None:
        self.targets.append(message)
        if self.follows and (pose := pose_of(message.pose)) is not None:
            self.tool = pose

    def _on_state(self, message: String) -> None:
        self.state = json.loads(message.data)
        self.levels[self.state["level"]] += 1


def stamped_transform(parent: str, child: str, pose: pin.SE3) -> TransformStamped:
    """Where a frame is in another, as /tf tells it; its stamp means nothing."""
    transform = transform_message(pose.translation, pin.Quaternion(pose.rotation).coeffs())
    message = TransformStamped(child_frame_id=child, transform=transform)
    message.header.frame_id = parent
    return message


def steps(targets: list[PoseStamped]) -> list[float]:
    """Distances between one target and the next [m]."""
    positions = [np.array([t.pose.position.x, t.pose.position.y, t.pose.position.z]) for t in targets]
    return [float(np.linalg.norm(after - before)) for before, after in pairwise(positions)]


def offset(pose: pin.SE3, by: tuple[float, float, float], turn: float = 0.0) -> pin.SE3:
    """A pose moved by [m] and turned about z [rad], both of the world."""
    return pin.SE3(pin.exp3(np.array([0.0, 0.0, turn])) @ pose.rotation, pose.translation + np.array(by))


def assert_same(pose: pin.SE3 | None, other: pin.SE3, tolerance: float) -> None:
    """Two poses are the same."""
    assert pose is not None
    np.testing.assert_allclose(pose.homogeneous, other.homogeneous, atol=tolerance)


def first(rig: ArmRig) -> pin.SE3:
    """The first target that came."""
    pose = pose_of(rig.targets[0].pose)
    assert pose is not None
    return pose
