"""A controller as strict as the community's, on a point mass: ``python -m tests.ros.stand_in --topic NAME ...``.

It follows targets by a critically damped spring, tells its tool on /tf, and prints a line for every rule that a target
breaks. It knows nothing of the package under test.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TransformStamped, WrenchStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

STIFFNESS, DAMPING = 900.0, 60.0  # of a unit mass [N/m, Ns/m]
DT = 0.005  # [s]
FASTEST = 0.55  # that a target may move [m/s]
FASTEST_TURN = 2.2  # [rad/s]
LONGEST_GAP = 0.3  # that a busy machine may leave between two targets [s]
SETTLED = 0.004  # from a tool or a target that rests [m]
SETTLED_TURN = 0.02  # [rad]
WRENCH_PATIENCE = 0.5  # [s]


class StandIn(Node):
    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__(options.node, namespace=options.namespace)
        self._options = options
        self._position = np.array(options.position)
        self._velocity = np.zeros(3)
        self._rotation = np.array([0.0, 1.0, 0.0, 0.0])
        self._target: tuple[Any, Any, float] | None = None
        self._began = math.inf
        self._zero_wrench = False
        self._tf = self.create_publisher(TFMessage, "/tf", 10)
        self.create_subscription(PoseStamped, options.topic, self._on_target, 1)
        if options.wrench:
            self.create_subscription(WrenchStamped, options.wrench, self._on_wrench, 1)
        self.create_timer(DT, self._move)

    @property
    def _now(self) -> float:
        return float(self.get_clock().now().nanoseconds) * 1e-9

    def _on_wrench(self, message: WrenchStamped) -> None:
        force, torque = message.wrench.force, message.wrench.torque
        self._zero_wrench = (force.x, force.y, force.z, torque.x, torque.y, torque.z) == (0.0,) * 6
        if message.header.frame_id != self._options.frame:
            print(f"violation: wrench in frame {message.header.frame_id!r}")

    def _on_target(self, message: PoseStamped) -> None:
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        at, turned = message.pose.position, message.pose.orientation
        position = np.array([at.x, at.y, at.z])
        rotation = np.array([turned.x, turned.y, turned.z, turned.w])
        for fault in self._faults(message.header.frame_id, stamp, position, rotation):
            print(f"violation: {fault}")
        if self._target is None:
            self._began = self._now
            print("first target")
        self._target = position, rotation, stamp

    def _faults(self, frame: str, stamp: float, position: Any, rotation: Any) -> list[str]:
        options, faults = self._options, []
        if options.frame and frame != options.frame:
            faults.append(f"frame {frame!r}")
        if (publishers := self.count_publishers(options.topic)) != 1:
            faults.append(f"{publishers} publishers")
        if self._now - stamp > options.longest_age:
            faults.append(f"stamp is {self._now - stamp:.3f} s old")
        if not (np.isfinite(position).all() and abs(np.linalg.norm(rotation) - 1.0) < 1e-6):
            faults.append("not a unit quaternion, or not finite")
            return faults
        if self._target is None:
            way, allowed = math.dist(position, self._position), SETTLED
            turn, allowed_turn = angle(rotation, self._rotation), SETTLED_TURN
        else:
            period = min(max(stamp - self._target[2], 0.0), LONGEST_GAP)
            way, allowed = math.dist(position, self._target[0]), FASTEST * period + SETTLED
            turn, allowed_turn = angle(rotation, self._target[1]), FASTEST_TURN * period + SETTLED_TURN
        if way > allowed or turn > allowed_turn:
            faults.append(f"jump of {way:.4f} m, {turn:.3f} rad")
        if options.wrench and not self._zero_wrench and self._now - self._began > WRENCH_PATIENCE:
            faults.append("no zero wrench")
        return faults

    def _move(self) -> None:
        if self._target is not None:
            acceleration = STIFFNESS * (self._target[0] - self._position) - DAMPING * self._velocity
            self._velocity = self._velocity + DT * acceleration
            self._position = self._position + DT * self._velocity
            self._rotation = self._target[1]
        transform = TransformStamped(child_frame_id=self._options.tool_frame)
        transform.header.frame_id = self._options.base_frame
        translation, rotation = transform.transform.translation, transform.transform.rotation
        translation.x, translation.y, translation.z = self._position.tolist()
        rotation.x, rotation.y, rotation.z, rotation.w = self._rotation.tolist()
        self._tf.publish(TFMessage(transforms=[transform]))


def angle(first: Any, second: Any) -> float:
    """Between two unit quaternions [rad]."""
    return 2.0 * math.acos(min(1.0, abs(float(first @ second))))


def main() -> None:
    parser = argparse.ArgumentParser()
    for name in ("topic", "frame", "wrench"):
        parser.add_argument(f"--{name}", default="")
    parser.add_argument("--node", default="left_ctrl")
    parser.add_argument("--namespace", default="/robot")
    parser.add_argument("--base-frame", default="robot_base")
    parser.add_argument("--tool-frame", default="left_tool_frame")
    parser.add_argument("--longest-age", type=float, default=0.5)
    parser.add_argument("--position", type=float, nargs=3, default=[0.5, 0.25, 0.38])
    rclpy.init()
    node = StandIn(parser.parse_args())
    print("ready")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()


if __name__ == "__main__":
    main()
