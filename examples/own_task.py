"""Your own task of the QP, which turns the left arm's elbow towards an angle while both tools keep their pose."""

import numpy as np

from q2r2_control import Array, CartesianController, Robot, load_config


class ElbowTask:
    """A task that pulls ``joint`` towards ``angle`` [rad]."""

    def __init__(self, robot: Robot, joint: str, angle: float) -> None:
        self.joint, self.angle = robot.joint_names.index(joint), angle

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return H and g of the cost 1/2 v' H v + g' v.

        The cost is least if the joint's velocity is 2/s times the remaining angle.
        """
        H, g = np.zeros((len(q), len(q))), np.zeros(len(q))
        H[self.joint, self.joint] = 0.1
        g[self.joint] = -0.1 * 2.0 * (self.angle - q[self.joint])
        return H, g


robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
controller = CartesianController(robot, tasks=[ElbowTask(robot, "left_A3", robot.home[2] + 0.3)])
goals = {arm: controller.tool_pose(arm) for arm in robot.arms}
for _ in range(2000):
    reference = controller.step(goals, 0.001)
print(f"left_A3 turned by {reference.q[2] - robot.home[2]:.2f} rad")
