"""If no file names a home posture, a search finds one."""

from __future__ import annotations

from q2r2_control.config.cell import Config
from q2r2_control.robot.home_search import find_home
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot


def test_an_arm_on_a_low_base_has_a_home_that_is_high_enough_for_scripted_hands() -> None:
    arm = {"model": "example-robot-data:ur5", "tip": "tool0", "home": [0.0, -1.0, 1.3, 0.4, 1.2, 0.0]}
    low = {"mount": {"position": [0.0, 0.0, 0.02]}}
    config = Config.model_validate({"name": "low", "arms": {"left": arm | low}})
    robot = Robot.from_config(config)
    home = find_home(robot, "left", robot.home, kept_distances(robot, config.control).values, ())
    wrist = {"left_wrist_3_link_0", "left_ee_link_0"}
    to_floor = [pair.distance for pair in robot.distances(home) if {pair.name_a, pair.name_b} - wrist == {"floor_0"}]
    assert len(to_floor) == len(wrist)
    assert min(to_floor) > config.control.min_distance + 0.137, "scripted hands go down by up to 0.137 m"
