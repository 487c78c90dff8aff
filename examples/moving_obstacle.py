"""A hand reaches into the cell. The arm slows down, keeps away from the hand, and goes on when the hand has gone."""

import numpy as np

from q2r2_control import CartesianController, MovingObstacle, Robot, load_config

config = load_config("config/dual_iiwa7.yaml")
robot = Robot.from_config(config)
settings = config.control.model_copy(update={"moving_obstacles": ("hand",)})
controller = CartesianController(robot, settings)
start = controller.tool_pose("left")

for tick in range(6000):
    t = 0.001 * tick
    if tick % 33 == 0:  # A camera would report the hand about 30 times per second.
        away = 0.15 + 0.6 * abs(t / 3.0 - 1.0)  # At 0.2 m/s, the hand comes from 0.75 m to 0.15 m and goes away.
        place = start.translation + np.array([0.0, away, 0.0])
        hand = MovingObstacle(shape="sphere", size=(0.1,), position=tuple(place.tolist()), speed=0.25)
        controller.move_obstacle("hand", hand)
    goal = start.copy()
    goal.translation += np.array([0.0, 0.0, 0.05 * np.sin(4.0 * t)])
    reference = controller.step({"left": goal}, 0.001)
    if tick % 500 == 0:
        report, fastest = reference.report, np.abs(reference.v).max()
        pair = " | ".join(report.tightest_pair)
        print(f"{t:.1f} s, hand {away:.2f} m away: {report.status}, {fastest:.2f} rad/s, {pair}")
