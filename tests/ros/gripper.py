"""A gripper behind control_msgs/action/GripperCommand: ``python -m tests.ros.gripper``.

It closes in steps of 10 mm from 50 mm open, tells each, and stalls at 20 mm as if something were between its fingers.
"""

from __future__ import annotations

import rclpy
from control_msgs.action import GripperCommand
from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.executors import ExternalShutdownException

STEPS = (0.05, 0.04, 0.03, 0.02)  # [m]


def grasp(goal: ServerGoalHandle) -> GripperCommand.Result:
    for position in STEPS:
        goal.publish_feedback(GripperCommand.Feedback(position=position, effort=0.0))
    goal.succeed()
    wanted = goal.request.command
    return GripperCommand.Result(
        position=STEPS[-1],
        effort=wanted.max_effort,
        stalled=wanted.position < STEPS[-1],
        reached_goal=wanted.position == STEPS[-1],
    )


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("gripper")
    ActionServer(node, GripperCommand, "gripper/command", grasp)
    print("ready")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()


if __name__ == "__main__":
    main()
