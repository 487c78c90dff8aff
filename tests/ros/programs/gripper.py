"""A gripper behind control_msgs/action/GripperCommand: ``python -m tests.ros.programs.gripper``.

It closes from 50 mm, stalls at 20 mm as if something were between its fingers, and holds that until it is cancelled.
"""

from __future__ import annotations

import time

import rclpy
from control_msgs.action import GripperCommand
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import MultiThreadedExecutor

from tests.ros.programs import until_interrupted

OPEN, HELD, STEP = 0.05, 0.02, 0.01  # [m]


def grasp(goal: ServerGoalHandle) -> GripperCommand.Result:
    position = OPEN
    while rclpy.ok() and not goal.is_cancel_requested:
        goal.publish_feedback(GripperCommand.Feedback(position=position, stalled=position == HELD))
        position = max(position - STEP, HELD)
        time.sleep(0.02)
    goal.canceled()
    return GripperCommand.Result(position=position, effort=goal.request.command.max_effort, stalled=position == HELD)


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("gripper")
    ActionServer(
        node,
        GripperCommand,
        "gripper/command",
        grasp,
        cancel_callback=lambda _: CancelResponse.ACCEPT,
        callback_group=ReentrantCallbackGroup(),  # a cancellation is served while the goal is executed
    )
    executor = MultiThreadedExecutor(num_threads=2)
    executor.add_node(node)
    print("ready")
    with until_interrupted():
        executor.spin()
    executor.shutdown()
    node.destroy_node()


if __name__ == "__main__":
    main()
