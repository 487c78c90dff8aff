"""Both arms draw a figure of eight, which is plotted: python examples/plot_figure.py [PICTURE.png]."""

import sys

import matplotlib as mpl
import numpy as np
import pinocchio as pin

mpl.use("Agg")
import matplotlib.pyplot as plt

from q2r2_control import CartesianController, Robot, load_config

DT, PERIOD = 0.001, 4.0  # Period of a tick, and time in which the figure is drawn once [s].

config = load_config("config/dual_iiwa7.yaml")
robot = Robot.from_config(config)
controller = CartesianController(robot, config.control)
controller.reset(robot.home)
starts = {arm: controller.tool_pose(arm) for arm in robot.arms}

phase = 2.0 * np.pi * np.arange(0.0, PERIOD, DT) / PERIOD
# Displacements of the targets from the tools' positions at the start (n, 3) [m].
figure = np.column_stack([np.zeros_like(phase), 0.04 * np.sin(2.0 * phase), 0.08 * np.sin(phase)])
drawn: dict[str, list[np.ndarray]] = {arm: [] for arm in robot.arms}
for offset in figure:
    controller.step({arm: pin.SE3(at.rotation, at.translation + offset) for arm, at in starts.items()}, DT)
    for arm, points in drawn.items():
        points.append(controller.tool_pose(arm).translation)

for arm, points in drawn.items():
    targets = starts[arm].translation + figure
    print(f"{arm} arm: largest error {1e3 * np.linalg.norm(points - targets, axis=1).max():.1f} mm")
    plt.plot(*np.array(points)[:, 1:].T, label=f"{arm} tool")
    plt.plot(*targets[:, 1:].T, "k:", linewidth=1.0)
plt.axis("equal")
plt.legend()
plt.savefig(sys.argv[1] if len(sys.argv) > 1 else "figure.png")
