"""Read the QP of each step, add a row and a cost, and solve it twice: python examples/qp_by_hand.py [PICTURE.png]."""

import sys
import warnings

import matplotlib as mpl
import numpy as np
import pinocchio as pin
import qpsolvers

mpl.use("Agg")
import matplotlib.pyplot as plt

from q2r2_control import CartesianController, Robot, load_config

DT, SOLVERS = 0.002, ("daqp", "osqp")
warnings.simplefilter("ignore", qpsolvers.warnings.SparseConversionWarning)

robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
controller = CartesianController(robot)
joint = robot.joint_names.index("left_A1")
left, right = controller.tool_pose("left"), controller.tool_pose("right")
targets = {"left": pin.SE3(left.rotation, right.translation), "right": pin.SE3(right.rotation, left.translation)}

speeds, differences, margins = [], [], []
for _ in range(1000):  # Each tool is sent to the position of the other tool.
    problem = controller.problem(targets, DT)  # The QP's variable is x = [v; s]: joint velocities, a slack per row.
    own_row = -np.eye(1, len(problem.q), joint)  # The row -v <= 0.1: left_A1 turns back at 0.1 rad/s at most.
    problem.G = own_row if problem.G is None else np.vstack([problem.G, own_row])
    problem.h = np.append([] if problem.h is None else problem.h, 0.1)
    problem.P[joint, joint] += 0.01  # This cost lets left_A1 turn as slowly as the tools allow.
    first, second = (qpsolvers.solve_problem(problem, solver=name).x for name in SOLVERS)
    reference = controller.advance(first, targets, DT)  # This step is certified. Without a solution, the arms brake.
    if first is not None and second is not None:
        differences.append(np.abs(first - second)[: robot.model.nv].max())
    speeds.append(reference.v[joint])
    margins.append(reference.report.margin)

print(f"left_A1 turned at {min(speeds):.3f} to {max(speeds):.3f} rad/s")
print(f"every pair keeps its distance: {min(margins) >= -1e-9}")
print(f"{' and '.join(SOLVERS)} both solved {len(differences)} of 1000, apart by {np.median(differences):.1e} rad/s")
plt.plot(DT * np.arange(len(speeds)), speeds, label="left_A1 [rad/s]")
plt.plot(DT * np.arange(len(margins)), 10.0 * np.array(margins), label="least margin of a pair [dm]")
plt.legend()
if len(sys.argv) > 1:
    plt.savefig(sys.argv[1])
