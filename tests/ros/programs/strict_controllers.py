"""Controllers of two arms that check each target: ``python -m tests.ros.programs.strict_controllers TERMS``.

They stand in for the controllers of other projects, whose rules are TERMS, the JSON of :class:`Terms`. Each arm's
controller is a node of its own, ``/robot/left_ctrl``, that prints a line for every rule that a target breaks. The arms
of the simulated robot are driven by the torques of an impedance; an arm without a target holds its posture. Nothing
here uses the package under test.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
import pinocchio as pin
import rclpy
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory

from tests.ros.programs import until_interrupted
from tests.ros.programs.impedance_model import ImpedanceModel

ARMS = ("left", "right")
FASTEST = 0.55  # that a target may move, where nothing else is said [m/s]
FASTEST_JOINT = 2.5  # that a joint's target may move [rad/s]
LONGEST_GAP = 0.3  # in a stream, on an overloaded machine [s]
SETTLED, SETTLED_TURN, SETTLED_JOINT = 0.004, 0.02, 0.02  # from a tool or a target that rests [m], [rad], [rad]
WRENCH_TIMEOUT = 0.5  # [s]
LONGEST_SILENCE = 1.0  # between two joint positions [s]
OLD_IN_A_ROW = 3  # stamps that are too old: fewer are the delay of an overloaded machine
STALL = 0.1  # after a longer stall a sender catches up no more than this [s]


@dataclass(frozen=True)
class Terms:
    """What a controller's own documentation requires."""

    topic: str  # below the controller's name
    message: str = "pose"  # or array, trajectory, lbr
    frame: str = "base"  # frame_id has to be its base link; any: any link; ignored: numbers are in the base link
    lowest_rate: float = 50.0  # [Hz]
    longest_age: float = 0.5  # of a stamp [s]; above 0.1 it is no rule of the controller, but a bound on our delay
    wrench: bool = False  # wants a zero one
    command_type: bool = False  # targets count after a call of switch_command_type with 2
    fastest: float = FASTEST  # that a target may move [m/s]
    fastest_turn: float = 2.2  # [rad/s]


class Controller(Node):
    """The controller of one arm."""

    def __init__(self, arm: str, terms: Terms, model: ImpedanceModel) -> None:
        super().__init__(f"{arm}_ctrl", namespace="/robot")
        self.arm, self.terms, self.model = arm, terms, model
        self._last: tuple[Any, float] | None = None  # target and stamp
        self._began, self._zero_wrench = math.inf, False
        self._old = 0  # stamps in a row
        self._switched = not terms.command_type
        kinds: dict[str, tuple[Callable[[], Any], Callable[..., None]]] = {
            "pose": (lambda: PoseStamped, self._on_pose),
            "array": (lambda: Float64MultiArray, lambda message: self._on_joints(message.data)),
            "trajectory": (lambda: JointTrajectory, self._on_trajectory),
            "lbr": (
                lambda: import_module("lbr_fri_idl.msg").LBRJointPositionCommand,
                lambda message: self._on_joints(message.joint_position),
            ),
        }
        kind, callback = kinds[terms.message]
        self._deactivated = False  # the sender of joint positions has announced it since the last one
        if terms.message != "pose":
            self.create_subscription(String, "/cartesian_controller/state", self._on_sender_state, 10)
        self._topic = f"/robot/{self.get_name()}/{terms.topic}"
        if terms.command_type:
            service = import_module("moveit_msgs.srv").ServoCommandType
            self.create_service(service, "~/switch_command_type", self._on_command_type)
        if terms.wrench:
            self.create_subscription(WrenchStamped, "~/target_wrench", self._on_wrench, 1)
        self.create_subscription(kind(), self._topic, callback, 1)

    @property
    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds) * 1e-9

    def _report(self, fault: str) -> None:
        print(f"violation: {self.arm}: {fault}", flush=True)

    def _on_command_type(self, request: Any, response: Any) -> Any:
        self._switched = response.success = request.command_type == 2
        return response

    def _on_wrench(self, message: WrenchStamped) -> None:
        force, torque = message.wrench.force, message.wrench.torque
        self._zero_wrench = (force.x, force.y, force.z, torque.x, torque.y, torque.z) == (0.0,) * 6
        if message.header.frame_id != f"{self.arm}_link_0":
            self._report(f"wrench in frame {message.header.frame_id!r}")

    def _on_pose(self, message: PoseStamped, info: Any) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        # At the time of sending: the delay until here depends on the load of the machine.
        age = 1e-9 * info["source_timestamp"] - stamp
        self._old = self._old + 1 if age > self.terms.longest_age else 0
        if self._old >= OLD_IN_A_ROW:
            self._report(f"stamp is {age:.3f} s old")
        at, turned = message.pose.position, message.pose.orientation
        position = np.array([at.x, at.y, at.z])
        rotation = np.array([turned.x, turned.y, turned.z, turned.w])
        if not (np.isfinite(position).all() and abs(np.linalg.norm(rotation) - 1.0) < 1e-6):
            self._report("not a unit quaternion, or not finite")
            return
        own = f"{self.arm}_link_0"
        frame = self.model.frame(message.header.frame_id if self.terms.frame == "any" else own)
        if frame is None or (self.terms.frame == "base" and message.header.frame_id != own):
            self._report(f"frame {message.header.frame_id!r}")
            return
        if not self._switched:
            self._report("a pose before the switch to poses")
            return
        self._step(frame * pin.SE3(pin.Quaternion(rotation).toRotationMatrix(), position), stamp)

    def _step(self, target: pin.SE3, stamp: float) -> None:
        tool, last = self.model.tool(self.arm), self._last
        gap = math.inf if last is None else max(stamp - last[1], 0.0)
        fastest, turning, faults = self.terms.fastest, self.terms.fastest_turn, []
        # A stream that begins, or begins again, does so at the tool.
        for before, period in ((None if last is None else last[0], gap), (tool if gap > LONGEST_GAP else None, 0.0)):
            if before is not None:
                period = min(period, STALL if gap > LONGEST_GAP else LONGEST_GAP)
                way = math.dist(target.translation, before.translation)
                turn = float(np.linalg.norm(pin.log3(before.rotation.T @ target.rotation)))
                far = way > fastest * period + SETTLED or turn > turning * period + SETTLED_TURN
                faults.append(f"jump of {way:.4f} m, {turn:.3f} rad in {gap:.3f} s" if far else "")
        if all(faults):
            self._report(faults[0])
        if self.terms.wrench and not self._zero_wrench and self._now - self._began > WRENCH_TIMEOUT:
            self._report("no zero wrench")
        self._take(target, stamp)

    def _on_trajectory(self, message: JointTrajectory) -> None:
        names, count = list(message.joint_names), len(message.points)
        if names != self.model.joints(self.arm) or count != 1:
            self._report(f"{count} points for {names}")
            return
        due = message.points[0].time_from_start.sec + 1e-9 * message.points[0].time_from_start.nanosec
        if not 0.0 < due <= 0.1:
            self._report(f"due in {due:.3f} s")
        self._on_joints(message.points[0].positions)

    def _on_joints(self, positions: Any) -> None:
        target, now = np.array(positions, float), self._now
        if target.shape != (7,) or not np.isfinite(target).all():
            self._report(f"not 7 finite positions: {list(positions)}")
            return
        period = math.inf if self._last is None else now - self._last[1]
        before = self.model.positions(self.arm) if self._last is None else self._last[0]
        allowed = SETTLED_JOINT + (0.0 if self._last is None else FASTEST_JOINT * period)
        if np.abs(target - before).max() > allowed:
            self._report(f"jump of {np.abs(target - before).max():.4f} rad, allowed {allowed:.4f}")
        if LONGEST_SILENCE < period < math.inf and not self._deactivated:
            self._report(f"nothing for {period:.3f} s")
        self._deactivated = False
        self._take(target, now)

    def _on_sender_state(self, message: String) -> None:
        if json.loads(message.data)["phase"] != "active":
            self._deactivated = True

    def _take(self, target: Any, stamp: float) -> None:
        if (publishers := self.count_publishers(self._topic)) != 1:
            self._report(f"{publishers} publishers")
        if self._last is None:
            self._began = self._now
            print(f"first target of {self.arm}", flush=True)
        self._last = target, stamp
        self.model.goals[self.arm] = target


class Driver(Node):
    """Commands the torques of both arms."""

    def __init__(self) -> None:
        super().__init__("impedance", namespace="/robot")
        self.model: ImpedanceModel | None = None
        self.controllers: list[Controller] = []
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._torques = self.create_publisher(Float64MultiArray, "/torque_commands", 1)
        self.create_subscription(String, "/robot_description", self._on_description, latched)
        self.create_subscription(JointState, "/joint_states", self._on_joint_state, newest)
        self.driving = False

    def _on_description(self, message: String) -> None:
        self.model = ImpedanceModel(message.data, {arm: f"{arm}_tool_frame" for arm in ARMS})

    def _on_joint_state(self, message: JointState) -> None:
        if self.model is not None:
            self.model.measure(message.name, message.position, message.velocity)
            self._torques.publish(Float64MultiArray(data=self.model.torques()))
            self.driving = self._torques.get_subscription_count() > 0


def main() -> None:
    terms = Terms(**json.loads(sys.argv[1]))
    rclpy.init()
    executor, driver = SingleThreadedExecutor(), Driver()
    executor.add_node(driver)
    with until_interrupted():
        while not driver.driving:
            executor.spin_once()
        assert driver.model is not None
        for arm in ARMS:
            executor.add_node(Controller(arm, terms, driver.model))
        print("ready", flush=True)
        executor.spin()


if __name__ == "__main__":
    main()
