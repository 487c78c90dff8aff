"""Your own controller of an arm in ROS 2. It follows the safe targets that the controller of q2r2 publishes.

Also start ``q2r2 ros up CELL.yaml``, with the parameter ``output:=none`` for its node ``cartesian_controller``.
"""

from contextlib import suppress

import numpy as np
import pinocchio as pin
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState

from q2r2_control import Robot, load_config

robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
data, frame, q = robot.model.createData(), robot.arms["left"].frame_id, robot.home.copy()

rclpy.init()
node = rclpy.create_node("my_controller")
commands = node.create_publisher(JointState, "/joint_commands", 1)


def follow(message: PoseStamped) -> None:
    """Move the tool half of the distance to the target, by one step of inverse kinematics (damped least squares)."""
    at, turn = message.pose.position, message.pose.orientation
    target = pin.XYZQUATToSE3(np.array([at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]))
    jacobian = pin.computeFrameJacobian(robot.model, data, q, frame, pin.LOCAL)
    error = pin.log6(robot.tool_pose(q, "left").actInv(target)).vector
    q[:] += 0.5 * jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(6), error)
    commands.publish(JointState(name=list(robot.joint_names), position=q.tolist()))
    print(f"target {1e3 * np.linalg.norm(error[:3]):.1f} mm away", flush=True)


TOPIC = "/cartesian_controller/safe_target/left"
node.create_subscription(PoseStamped, TOPIC, follow, qos_profile_sensor_data)
print(f"waits for targets on {TOPIC}", flush=True)
with suppress(KeyboardInterrupt, ExternalShutdownException):  # These exceptions end the node without a traceback.
    rclpy.spin(node)
