"""The settings of the plant, which are in the cell's YAML under ``plant_settings.franka``."""

from __future__ import annotations

from ipaddress import ip_address
from typing import Annotated, Literal

from pydantic import Field

from q2r2_control import Config, ConfigError, StrictModel

_Torque = Annotated[float, Field(gt=0, le=200)]
_Force = Annotated[float, Field(gt=0, le=500)]
_Torques = tuple[_Torque, _Torque, _Torque, _Torque, _Torque, _Torque, _Torque]
_Forces = tuple[_Force, _Force, _Force, _Force, _Force, _Force]
_Metres = Annotated[float, Field(ge=-1, le=1)]
_Inertia = Annotated[float, Field(ge=-10, le=10)]


class CollisionSettings(StrictModel):
    """Thresholds above which the robot counts a torque or a force as a collision and ends the motion by a reflex."""

    torques: _Torques = Field(
        (40.0, 40.0, 36.0, 36.0, 32.0, 28.0, 24.0), description="thresholds of the joints' external torques [Nm]"
    )
    forces: _Forces = Field(
        (40.0, 40.0, 40.0, 50.0, 50.0, 50.0), description="thresholds of the external force [N] and moment [Nm]"
    )


class LoadSettings(StrictModel):
    """The load that the arm carries in addition to the end effector that is set in Desk."""

    mass: float = Field(0.0, ge=0, le=10, description="mass [kg]")
    centre: tuple[_Metres, _Metres, _Metres] = Field(
        (0.0, 0.0, 0.0), description="centre of mass in the frame of the flange [m]"
    )
    inertia: tuple[_Inertia, _Inertia, _Inertia, _Inertia, _Inertia, _Inertia] = Field(
        (0.0,) * 6, description="inertia about the centre of mass: xx, xy, xz, yy, yz, zz [kg m^2]"
    )


class HandSettings(StrictModel):
    """The settings of an arm's Franka Hand."""

    width: float = Field(0.08, gt=0, le=0.1, description="width when it is open [m]")
    speed: float = Field(0.1, gt=0, le=0.1, description="speed of the width [m/s]")
    force: float = Field(20.0, gt=0, le=70, description="force of a grasp [N]")
    homes: bool = Field(False, description="the hand finds its greatest width when it is connected: the fingers move")


class FrankaArmSettings(StrictModel):
    """The settings of one arm and its robot."""

    address: str = Field(min_length=1, description="address or host name of the robot's control")
    collision: CollisionSettings = CollisionSettings()
    load: LoadSettings | None = Field(None, description="null: the load that is set in Desk")
    hand: HandSettings | None = Field(None, description="null: no hand is commanded")


class FrankaSettings(StrictModel):
    """The settings of all arms."""

    left: FrankaArmSettings | None = None
    right: FrankaArmSettings | None = None
    real_time: Literal["enforce", "ignore"] = Field(
        "enforce", description="ignore: commands are sent although the kernel has no real-time scheduling"
    )
    record: str | None = Field(None, description="file for every command that is sent, for python -m q2r2_franka.check")

    @property
    def arms(self) -> dict[str, FrankaArmSettings]:
        both = {"left": self.left, "right": self.right}
        return {arm: its for arm, its in both.items() if its is not None}


def is_loopback(address: str) -> bool:
    """Return whether ``address``, which is an IP address or a host name, surely belongs to this computer."""
    try:
        return ip_address(address).is_loopback
    except ValueError:  # It is a host name.
        return address == "localhost"


def franka_settings(config: Config) -> FrankaSettings:
    """Return the checked settings of a cell.

    Raises:
        ConfigError: If a key is missing or a value is not allowed.
    """
    given = config.plant_settings.get("franka")
    if given is None:
        raise ConfigError(
            "plant_settings.franka: missing; allowed: the robot of each arm, as left: {address: 172.16.0.2}"
        )
    try:
        return FrankaSettings.model_validate(given)
    except ConfigError as error:
        raise error.at("plant_settings.franka: ") from error
