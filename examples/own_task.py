"""Your own task of the QP: the left arm's elbow turns towards an angle while both tools keep their pose.

Of an installed package, pyproject.toml names the task, and a cell's YAML asks for it under ``control.tasks``:

    [project.entry-points."q2r2_control.tasks"]
    elbow = "my_package:ElbowTask"
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from q2r2_control import CartesianController, ControllerSettings, Robot, load_config
from q2r2_control.types import Array


class ElbowTask:
    """Its cost is least where the joint moves to ``angle`` [rad] with 2 /s; limits and distances are kept anyway."""

    def __init__(self, robot: Robot, joint: str, angle: float, weight: float = 0.1) -> None:
        self._at, self._angle, self._weight = robot.joint_names.index(joint), angle, weight

    def cost(self, q: Array, v: Array) -> tuple[Array, Array]:
        """H and g of 1/2 v' H v + g' v."""
        H, g = np.zeros((len(q), len(q))), np.zeros(len(q))
        H[self._at, self._at] = self._weight
        g[self._at] = -self._weight * 2.0 * (self._angle - q[self._at])
        return H, g


with tempfile.TemporaryDirectory() as folder:
    # This is what pip writes of the lines above; here the package is this script.
    information = Path(folder) / "my_package-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[q2r2_control.tasks]\nelbow = __main__:ElbowTask\n")
    sys.path.insert(0, folder)

    robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
    wanted = float(robot.home[2]) + 0.3
    settings = ControllerSettings(tasks={"elbow": {"joint": robot.joint_names[2], "angle": wanted}})
    controller = CartesianController(robot, settings)

controller.reset(robot.home)
goals = {arm: controller.tool_pose(arm) for arm in robot.arms}
for _ in range(2000):
    reference = controller.step(goals, 0.001)
moved = np.linalg.norm(controller.tool_pose("left").translation - goals["left"].translation)
print(f"{robot.joint_names[2]} turned by {reference.q[2] - robot.home[2]:.2f} rad, the tool moved {1e3 * moved:.2f} mm")
