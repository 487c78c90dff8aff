"""Your own controller of an arm in ROS 2: it follows the targets that q2r2's controller has made safe.

Beside it: q2r2 ros up CELL.yaml, whose ``cartesian_controller`` has ``output:=none``. With --once it gives itself one
target, answers it, and ends.
"""

import sys

import numpy as np
import pinocchio as pin
import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState

from q2r2_control import Robot, load_config

ARM, TOPIC = "left", "/cartesian_controller/safe_target/left"
GAIN, DAMPING = 0.5, 1e-3  # of the way to the target that a message makes good, and of the pseudo-inverse

robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
data, frame, q = robot.model.createData(), robot.arms[ARM].frame_id, robot.home.copy()

rclpy.init()
node = rclpy.create_node("my_controller")
commands = node.create_publisher(JointState, "/joint_commands", 1)


def follow(message: PoseStamped) -> None:
    """One step of inverse kinematics by damped least squares towards the target."""
    at, turn = message.pose.position, message.pose.orientation
    target = pin.XYZQUATToSE3(np.array([at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]))
    jacobian = pin.computeFrameJacobian(robot.model, data, q, frame, pin.LOCAL)
    error = pin.log6(robot.tool_pose(q, ARM).actInv(target)).vector
    q[:] += GAIN * jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + DAMPING * np.eye(6), error)
    commands.publish(JointState(name=list(robot.joint_names), position=q.tolist()))
    print(f"target {1e3 * np.linalg.norm(error[:3]):.1f} mm away", flush=True)


node.create_subscription(PoseStamped, TOPIC, follow, qos_profile_sensor_data)
if "--once" in sys.argv:
    message, wanted = PoseStamped(), pin.SE3ToXYZQUAT(robot.tool_pose(q, ARM)).tolist()
    at, turn = message.pose.position, message.pose.orientation
    at.x, at.y, at.z = wanted[0], wanted[1], wanted[2] + 0.05
    turn.x, turn.y, turn.z, turn.w = wanted[3:]
    targets = node.create_publisher(PoseStamped, TOPIC, qos_profile_sensor_data)
    while np.array_equal(q, robot.home):
        targets.publish(message)
        rclpy.spin_once(node, timeout_sec=0.1)
else:
    rclpy.spin(node)
node.destroy_node()
rclpy.shutdown()
