"""The drive of a command mode."""

from __future__ import annotations

from q2r2_control.config.cell import Config
from q2r2_control.drives.base import Drive
from q2r2_control.drives.position import PositionDrive, VelocityDrive
from q2r2_control.drives.torque import TorqueDrive
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode


def make_drive(mode: CommandMode, robot: Robot, config: Config, has_servos: bool = True) -> Drive:
    """The drive of ``mode``; ``has_servos``: whether the plant follows positions too when torques are not safe."""
    if mode is CommandMode.TORQUE:
        return TorqueDrive(robot, config, has_servos)
    return VelocityDrive(robot, config) if mode is CommandMode.VELOCITY else PositionDrive(robot, config)
