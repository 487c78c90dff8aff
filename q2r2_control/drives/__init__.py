"""Ways to drive a plant: what becomes of a reference before it is sent, the same for every loop.

``position`` sends the reference itself, or its velocity; ``torque`` sends the torques of an impedance about it. The
pipeline hands the commands to a plant, the ROS nodes turn them into messages. What stops the arms is not decided here
but in ``supervision``.
"""

from __future__ import annotations

from q2r2_control.config import Config
from q2r2_control.drives.base import Drive, DriveReport, permitted
from q2r2_control.drives.position import PositionDrive, VelocityDrive
from q2r2_control.drives.torque import TorqueDrive
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode

__all__ = ["Drive", "DriveReport", "PositionDrive", "TorqueDrive", "VelocityDrive", "make_drive", "permitted"]


def make_drive(mode: CommandMode, robot: Robot, config: Config, has_servos: bool = True) -> Drive:
    """The drive of ``mode``; ``has_servos``: whether the plant follows positions too when torques are not safe."""
    if mode is CommandMode.TORQUE:
        return TorqueDrive(robot, config, has_servos)
    return VelocityDrive(robot, config) if mode is CommandMode.VELOCITY else PositionDrive(robot, config)
