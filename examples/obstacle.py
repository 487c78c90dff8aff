"""An obstacle between a tool and its target. The arm does not go through it."""

import numpy as np
import pinocchio as pin

from q2r2_control import CartesianController, ObstacleConfig, Robot, load_config

config = load_config("config/dual_iiwa7.yaml")
empty = Robot.from_config(config)
tool = empty.tool_pose(empty.home, "left").translation

# The post stands 15 cm to the left of the left tool.
post = ObstacleConfig(shape="capsule", size=(0.03, 0.6), position=tuple(tool + np.array([0.0, 0.15, 0.0])))
config = config.model_copy(update={"obstacles": {**config.obstacles, "post": post}})

robot = Robot.from_config(config)
controller = CartesianController(robot, config.control)
controller.reset(robot.home)
start = controller.tool_pose("left")
goal = pin.SE3(start.rotation, start.translation + np.array([0.0, 0.3, 0.0]))

nearest, pair = np.inf, ("", "")
for _ in range(3000):
    reference = controller.step({"left": goal}, 0.001)
    if reference.report.closest_distance < nearest:
        nearest, pair = reference.report.closest_distance, reference.report.closest_pair
error = np.linalg.norm(controller.tool_pose("left").translation - goal.translation)
print(f"nearest {1e3 * nearest:.1f} mm: {' and '.join(pair)}; the tool stays {1e3 * error:.0f} mm from its target")
