"""The shipped cell, for tests of the supervision that stops its arms."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot, load_config
from q2r2_control.config.cell import Config
from q2r2_control.config.control import SupervisionSettings
from q2r2_control.supervision.joint_watch import watch_settings

CONFIG = "config/dual_iiwa7.yaml"
# With these settings, a state that is not finite is a fault at once.
STRICT = watch_settings(SupervisionSettings(unusable_time=0.0), yields=False)


def raised(pose: pin.SE3, by: float) -> pin.SE3:
    """Return the pose moved up ``by`` [m]."""
    return pin.SE3(pose.rotation, pose.translation + np.array([0.0, 0.0, by]))


def unhurried(config: Config) -> ControllerSettings:
    """Return settings in which no solution is late, because lateness depends on the machine."""
    return config.control.model_copy(update={"solve_time_limit": None})


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot, unhurried(load_config(CONFIG)))
