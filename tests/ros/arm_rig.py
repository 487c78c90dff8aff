"""Test rig of arm controllers: it sends hand data and tool poses, and records the outputs."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
from geometry_msgs.msg import PoseStamped, TransformStamped
from quest2ros.msg import OVR2ROSHapticFeedback, OVR2ROSInputs
from rclpy.qos import QoSProfile
from std_msgs.msg import Bool, String
from tf2_msgs.msg import TFMessage

from q2r2_control.ros.base_node import COMMAND_QOS, LATCHED_QOS, STREAM_QOS
from q2r2_control.ros.bridge.messages import pose_of, stamped_pose
from tests.ros.processes import Processes, RosProcess, wait_until

PERIOD = 1.0 / 72.0  # Period of the hand's messages, as a Quest sends them, and of /tf [s].
ANSWER_PERIOD = 0.2  # Period of the built-in controller's reports [s].
HAND = pin.SE3(pin.exp3(np.array([0.2, -0.4, 0.6])), np.array([0.3, 0.1, 1.0]))
TOOL = pin.SE3(pin.exp3(np.array([3.0, 0.2, 0.1])), np.array([0.5, 0.25, 0.38]))
# The timeout is longer than the default, so that other load on the machine does not look like a fault.
PATIENT = {"teleop.gate.timeout": 2.0, "tool_timeout": 2.0, "listener_timeout": 3.0}


def patient(parameters: Mapping[str, Any]) -> list[str]:
    return [f"{name}:={value}" for name, value in (PATIENT | dict(parameters)).items()]


HOLDING = ("paused", "lost")  # States in which an arm holds after it was engaged.


class ArmRig:
    """The hand and the robot of one arm.

    If ``follows`` is True, the tool is always at the newest target. If ``sends_tool`` is True, the tool's pose is on
    /tf.
    """

    def __init__(
        self,
        node: Any,
        arm: str = "left",
        topic: str | None = None,
        tool_frame: str | None = None,
        robot: str = "q2r2",
        answers: bool | None = None,
    ) -> None:
        """If ``answers`` is True, the rig reports its state like the built-in controller.

        The default of ``answers`` is True if ``topic`` is None, because the rig then takes that controller's targets.
        """
        self.arm, self.node = arm, node
        self.hand, self.tool = HAND, TOOL
        self.lower = self.upper = False
        self.grip = self.trigger = 0.0
        self.sends_hand = self.sends_tool = self.follows = True
        self.sent = 0  # Number of messages of the hand since the last press or release of a button.
        self.targets: list[PoseStamped] = []
        self.state: dict[str, Any] = {}
        self.ready_states = 0  # Number of ready states in a row.
        self.pulses: list[tuple[float, float]] = []
        self._frame = tool_frame or f"{arm}_tool_frame"
        self._made = [
            node.create_publisher(PoseStamped, f"q2r_{arm}_hand_pose", STREAM_QOS),
            node.create_publisher(OVR2ROSInputs, f"q2r_{arm}_hand_inputs", STREAM_QOS),
            node.create_publisher(TFMessage, "/tf", 100),
        ]
        if topic is None if answers is None else answers:
            self._answers = node.create_publisher(String, "/cartesian_controller/state", 10)
            followed = node.create_publisher(Bool, f"/cartesian_controller/following/{arm}", LATCHED_QOS)
            followed.publish(Bool(data=True))
            node.create_timer(ANSWER_PERIOD, self._answer)
        self._listens = [
            node.create_subscription(PoseStamped, topic or f"/q2r2/{arm}/target_frame", self._on_target, COMMAND_QOS),
            node.create_subscription(String, f"/{arm}_{robot}_arm_controller/state", self._on_state, 10),
            node.create_subscription(
                OVR2ROSHapticFeedback,
                f"q2r_{arm}_hand_haptic_feedback",
                lambda message: self.pulses.append((round(message.frequency, 3), round(message.amplitude, 3))),
                # No message is lost while this process stalls.
                QoSProfile(depth=100, reliability=COMMAND_QOS.reliability),
            ),
        ]
        self._timer = node.create_timer(PERIOD, self._send)

    def start(self, processes: Processes, parameters: dict[str, Any] | None = None) -> RosProcess:
        process = processes.start_node(f"{self.arm}_arm_controller", *patient(parameters or {}))
        self.wait_until_connected()
        return process

    def wait_until_connected(self) -> None:
        self.wait(lambda: self.state.get("hand_age") is not None, "the controller receives the hand")

    def wait(self, condition: Callable[[], Any], what: str) -> None:
        wait_until(condition, what, lambda: self.state)

    def press(self, button: str = "lower") -> None:
        ArmRigs([self]).press(button)

    def engage(self) -> None:
        ArmRigs([self]).engage()

    def pause(self) -> None:
        ArmRigs([self]).pause()

    def move(self, by: tuple[float, float, float], duration: float = 0.4, turn: float = 0.0) -> None:
        start, began, share = self.hand, time.monotonic(), 0.0
        while share < 1.0:
            share = min((time.monotonic() - began) / duration, 1.0)
            self.hand = offset(start, tuple(share * np.array(by)), share * turn)
            time.sleep(PERIOD / 2)

    def let_the_hand_rest(self) -> None:
        """Send the pose of a resting hand until the controller's filter, which is slowest at rest, has reached it."""
        self.sent = 0
        self.wait(lambda: self.sent > 2.0 / PERIOD, "the hand rests")

    def newest(self) -> pin.SE3:
        return target_of(self, -1)

    def wait_for_rest(self) -> pin.SE3:
        """Wait until the target rests or no more targets come, and return the target."""

        def rests() -> bool:
            before = self.newest()
            time.sleep(0.3)
            return bool(before.isApprox(self.newest(), 1e-6))

        wait_until(rests, "the target comes to rest")
        return self.newest()

    def _answer(self) -> None:
        said = {f"{self.arm}_state": "holding", "fault": None, "homing_outcome": None}
        self._answers.publish(String(data=json.dumps(said)))

    def _send(self) -> None:
        now = self.node.get_clock().now().nanoseconds * 1e-9
        pose, inputs, tf = self._made
        if self.sends_hand:
            pose.publish(stamped_pose(self.hand, "", now))
            held = {"press_middle": self.grip, "press_index": self.trigger}
            inputs.publish(OVR2ROSInputs(button_upper=self.upper, button_lower=self.lower, **held))
            self.sent += 1
        if self.sends_tool:
            tf.publish(TFMessage(transforms=[stamped_transform("world", self._frame, self.tool)]))

    def _on_target(self, message: PoseStamped) -> None:
        self.targets.append(message)
        if self.follows and (pose := pose_of(message.pose)) is not None:
            self.tool = pose

    def _on_state(self, message: String) -> None:
        self.state = json.loads(message.data)
        ready = self.state["ready"] and self.state["level"] == "ok"
        self.ready_states = self.ready_states + 1 if ready else 0


class ArmRigs:
    """Several rigs whose hands make the same motion at the same time."""

    def __init__(self, rigs: list[ArmRig]) -> None:
        self.rigs = rigs

    def wait(self, condition: Callable[[ArmRig], Any], what: str) -> None:
        for rig in self.rigs:
            rig.wait(partial(condition, rig), f"{rig.arm}: {what}")

    def engage(self) -> None:
        self.wait_until_ready(1)
        self.press_until(lambda rig: rig.state.get("engaged"), "the arm is engaged")

    def wait_until_ready(self, states: int) -> None:
        """Wait until each rig has been ready in ``states`` new states in a row."""
        for rig in self.rigs:
            rig.ready_states = 0
        self.wait(lambda rig: rig.ready_states >= states, "nothing keeps the arm from being engaged")

    def pause(self) -> None:
        self.press_until(lambda rig: rig.state.get("state") in HOLDING, "the arm is paused")

    def wait_for_pause(self) -> None:
        self.wait(lambda rig: rig.state.get("state") in HOLDING, "the arm is paused")

    def move(self, by: tuple[float, float, float], duration: float, turn: float = 0.0) -> None:
        threads = [threading.Thread(target=rig.move, args=(by, duration, turn)) for rig in self.rigs]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def interrupt_hand_data(self) -> None:
        """Send no hand data until all arms are paused. Then send them again, with the hands at other positions."""
        for rig in self.rigs:
            rig.sends_hand = False
        self.wait_for_pause()
        for rig in self.rigs:
            rig.hand = offset(rig.hand, (0.4, -0.4, 0.4))
            rig.sends_hand = True

    def press_until(self, condition: Callable[[ArmRig], Any], what: str) -> None:
        """Press the lower buttons of the rigs for which ``condition`` does not hold yet, and wait until it holds."""
        rigs = [rig for rig in self.rigs if not condition(rig)]
        ArmRigs(rigs).press()
        self.wait(condition, what)

    def press(self, button: str = "lower") -> None:
        """Hold one button of each hand for several messages, and release it for several messages. This is no chord."""
        for held in (True, False):
            for rig in self.rigs:
                setattr(rig, button, held)
            for rig in self.rigs:
                rig.sent = 0
            time.sleep(0.2)
            self.wait(lambda rig: rig.sent > 3, "it is sent")


def stamped_transform(parent: str, child: str, pose: pin.SE3) -> TransformStamped:
    """Return the transform of a frame in another frame, as on /tf, without a stamp."""
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id = parent
    message.transform.rotation, to = stamped_pose(pose, "", 0.0).pose.orientation, message.transform.translation
    to.x, to.y, to.z = pose.translation.tolist()
    return message


def steps(targets: list[PoseStamped]) -> list[float]:
    positions = [np.array([t.pose.position.x, t.pose.position.y, t.pose.position.z]) for t in targets]
    return [float(np.linalg.norm(after - before)) for before, after in pairwise(positions)]


def offset(pose: pin.SE3, by: tuple[float, float, float], turn: float = 0.0) -> pin.SE3:
    return pin.SE3(pin.exp3(np.array([0.0, 0.0, turn])) @ pose.rotation, pose.translation + np.array(by))


def assert_same(pose: pin.SE3 | None, other: pin.SE3, tolerance: float) -> None:
    assert pose is not None
    np.testing.assert_allclose(pose.homogeneous, other.homogeneous, atol=tolerance)


def target_of(rig: ArmRig, number: int = 0) -> pin.SE3:
    """Return the target with this index among those that came."""
    pose = pose_of(rig.targets[number].pose)
    assert pose is not None
    return pose
