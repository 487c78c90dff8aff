from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.robot.coal_distances import CoalDistances
from q2r2_control.robot.robot import Robot


def test_the_distances_at_each_posture_equal_the_distances_that_coal_computes_for_each_single_pair(
    robot: Robot,
) -> None:
    distances = CoalDistances(robot.model, robot.collision_model)
    data, geometry_data = robot.model.createData(), robot.collision_model.createData()
    for q in np.random.default_rng(1).uniform(robot.position_lower, robot.position_upper, (5, robot.model.nv)):
        pin.updateGeometryPlacements(robot.model, data, robot.collision_model, geometry_data, q)
        expected = [
            pin.computeDistance(robot.collision_model, geometry_data, pair).min_distance
            for pair in range(len(robot.collision_model.collisionPairs))
        ]
        np.testing.assert_array_equal(distances.at(q), expected)
        np.testing.assert_array_equal(distances.measured(), expected)
