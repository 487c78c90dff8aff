"""Bimanual VR teleoperation and Cartesian control with a safe QP controller.

The fixed API; everything else may move between versions.
"""

from q2r2_control.config import load_config
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.settings import ControllerSettings
from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.pipeline import Pipeline
from q2r2_control.robot.robot import Robot
from q2r2_control.summary import RunSummary
from q2r2_control.teleop.relative import RelativeMotion

__all__ = [
    "CartesianController",
    "ConfigError",
    "ControllerSettings",
    "Pipeline",
    "Q2R2Error",
    "RelativeMotion",
    "Robot",
    "RunSummary",
    "load_config",
]
