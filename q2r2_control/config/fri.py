"""Settings of KUKA's cabinets, whose Fast Robot Interface moves the arms, and of the arms' grippers."""

from __future__ import annotations

import re
from ipaddress import ip_address
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, field_validator

from q2r2_control.config.strict import StrictModel


class GripperIoConfig(StrictModel):
    """A gripper on inputs and outputs of the cabinet, with the names that they have in the Sunrise project."""

    output: str = Field(
        min_length=1, description="name of the output for the opening: 0 closed .. 1 open, or on for open"
    )
    input: str | None = Field(
        None, description="name of the input with the measured opening, 0 closed .. 1 open; null: no measurement"
    )
    digital: bool = Field(False, description="true if the output is digital, which is on or off")


# Within this time, a gripper on Modbus has to get its newest command, and its opening has to be measured [s]. Otherwise
# the opening counts as not known.
MODBUS_DELAY = 0.15
_ENDPOINT = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^\s:/]+)(?::([0-9]{1,5}))?")
_Count = Annotated[int, Field(ge=0, le=255)]


class ModbusGripperConfig(StrictModel):
    """A Robotiq Hand-E, 2F-85 or 2F-140 by Modbus TCP, or by Modbus RTU on a serial device: 115200 baud, 8N1."""

    modbus: str = Field(description="host:port or host, or a serial device such as /dev/ttyUSB0")
    unit: int = Field(9, ge=1, le=247, description="slave number of the gripper")
    speed: float = Field(1.0, ge=0, le=1, description="speed of the fingers, 0 slowest .. 1 fastest")
    force: float = Field(0.5, ge=0, le=1, description="force of a grasp, 0 least .. 1 greatest")
    counts: tuple[_Count, _Count] = Field(
        (0, 255),
        description="counts when open and closed, as q2r2 fri-check prints; 2F-85, 2F-140: about [3, 230]",
    )

    @field_validator("modbus")
    @classmethod
    def _is_somewhere(cls, modbus: str) -> str:
        found = _ENDPOINT.fullmatch(modbus)
        if not modbus.startswith("/") and not (found and 1 <= int(found[2] or 502) <= 65535):
            raise ValueError("allowed is host:port or host, or a serial device such as /dev/ttyUSB0")
        return modbus

    @field_validator("counts")
    @classmethod
    def _closes_upwards(cls, counts: tuple[int, int]) -> tuple[int, int]:
        if counts[0] >= counts[1]:
            raise ValueError("allowed is a count for closed above the one for open")
        return counts

    @property
    def endpoint(self) -> tuple[str, int] | None:
        """Host and port of Modbus TCP; None if ``modbus`` is a serial device."""
        found = _ENDPOINT.fullmatch(self.modbus)
        return None if found is None else (found[1].strip("[]"), int(found[2] or 502))


def _kind(gripper: Any) -> str:
    """Return the tag of a gripper's pydantic model. Tags are in brackets, so that error messages can leave them out."""
    by_modbus = "modbus" in gripper if isinstance(gripper, dict) else isinstance(gripper, ModbusGripperConfig)
    return "[modbus]" if by_modbus else "[io]"


_AnyGripper = Annotated[
    Annotated[GripperIoConfig, Tag("[io]")] | Annotated[ModbusGripperConfig, Tag("[modbus]")], Discriminator(_kind)
]


class CabinetConfig(StrictModel):
    """The cabinet of one arm, which sends to a port of this computer."""

    address: str = Field("127.0.0.1", description="address of the cabinet; messages from others are ignored")
    port: int = Field(30200, ge=0, le=65535, description="port of this computer, as in the Sunrise project")
    version: Literal[1, 2] | None = Field(None, description="version of FRI; null: that of the cabinet's messages")
    gripper: _AnyGripper | None = Field(
        None, description="gripper on inputs and outputs of the cabinet, or by Modbus; null: no gripper is commanded"
    )

    @field_validator("address")
    @classmethod
    def _is_address(cls, address: str) -> str:
        return str(ip_address(address))
