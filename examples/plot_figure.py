"""Both arms draw a figure of eight, plotted: python examples/plot_figure.py [PICTURE.png]."""

import sys

import matplotlib as mpl
import numpy as np
import pinocchio as pin

mpl.use("Agg")
import matplotlib.pyplot as plt

from q2r2_control import CartesianController, Robot, load_config

DT, PERIOD = 0.001, 4.0  # [s]

config = load_config("config/dual_iiwa7.yaml")
robot = Robot.from_config(config)
controller = CartesianController(robot, config.control)
controller.reset(robot.home)
starts = {arm: controller.tool_pose(arm) for arm in robot.arms}

asked: dict[str, list[np.ndarray]] = {arm: [] for arm in robot.arms}
drawn: dict[str, list[np.ndarray]] = {arm: [] for arm in robot.arms}
for t in np.arange(0.0, PERIOD, DT):
    phase = 2.0 * np.pi * t / PERIOD
    offset = np.array([0.0, 0.04 * np.sin(2.0 * phase), 0.08 * np.sin(phase)])
    targets = {arm: pin.SE3(start.rotation, start.translation + offset) for arm, start in starts.items()}
    controller.step(targets, DT)
    for arm, target in targets.items():
        asked[arm].append(target.translation)
        drawn[arm].append(controller.tool_pose(arm).translation)

for arm in robot.arms:
    targets_yz, tools_yz = np.array(asked[arm])[:, 1:], np.array(drawn[arm])[:, 1:]
    plt.plot(*tools_yz.T, label=f"{arm} tool")
    plt.plot(*targets_yz.T, "k:", linewidth=1.0)
    print(f"{arm} arm: largest error {1e3 * np.linalg.norm(tools_yz - targets_yz, axis=1).max():.1f} mm")
plt.axis("equal")
plt.xlabel("y [m]")
plt.ylabel("z [m]")
plt.legend()
plt.savefig(sys.argv[1] if len(sys.argv) > 1 else "figure.png")
