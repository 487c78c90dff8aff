"""Plants by name, and the modes that they have."""

from __future__ import annotations

from q2r2_control.config.cell import Config
from q2r2_control.errors import ConfigError
from q2r2_control.plants.base import Plant
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode

PLANTS = ("mujoco", "kinematic")


def make_plant(plant: Plant | str, robot: Robot, config: Config) -> Plant:
    """The plant called ``plant``, or ``plant`` itself. Raises :class:`ConfigError` for an unknown name."""
    if plant == "mujoco":
        return MujocoPlant(robot, config)
    if plant == "kinematic":
        return KinematicPlant(robot, config)
    if isinstance(plant, str):
        raise ConfigError(f"plant {plant!r}: allowed are {', '.join(PLANTS)}")
    return plant


def check_mode(mode: CommandMode | str, plant: Plant) -> CommandMode:
    """``mode`` as one that ``plant`` follows. Raises :class:`ConfigError` for any other."""
    if mode not in plant.modes:
        allowed = ", ".join(plant.modes)
        raise ConfigError(f"mode {mode!s:.40}: {type(plant).__name__} follows {allowed} commands only")
    return CommandMode(mode)
