"""Your own control loop, which turns targets into safe joint references every millisecond."""

import numpy as np
import pinocchio as pin

from q2r2_control import CartesianController, ControllerSettings, Robot, load_config

DT = 0.001  # Period of the loop [s].

robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
controller = CartesianController(robot, ControllerSettings(acceleration_limit=10.0, min_distance=0.02))
controller.reset(robot.home)

# The target of the left tool is 10 cm higher and turned. The right arm has no target, so it holds its reference.
start = controller.tool_pose("left")
goal = pin.SE3(start.rotation @ pin.rpy.rpyToMatrix(0.0, 0.3, 0.0), start.translation + np.array([0.0, 0.0, 0.1]))

fastest = 0.0
for _ in range(2000):
    reference = controller.step({"left": goal}, DT)
    fastest = max(fastest, float(np.abs(reference.v).max()))
    assert reference.report.certified  # The controller knows a full stop that keeps every limit.
    # Send reference.q, reference.v to your robot here.

error = np.linalg.norm(controller.tool_pose("left").translation - goal.translation)
print(f"left tool {1e3 * error:.2f} mm from its target, fastest joint {fastest:.2f} rad/s")
print(f"closest pair: {reference.report.closest_pair}")
