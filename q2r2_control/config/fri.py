"""Where KUKA's cabinets are, whose Fast Robot Interface moves the arms."""

from __future__ import annotations

from ipaddress import ip_address
from typing import Literal

from pydantic import Field, field_validator

from q2r2_control.config.strict import StrictModel


class GripperIoConfig(StrictModel):
    """A gripper on named inputs and outputs of the cabinet, as they are called in the Sunrise project."""

    output: str = Field(min_length=1, description="that gets the opening: 0 closed .. 1 open, or on for open")
    input: str | None = Field(None, description="that has the measured opening, 0 closed .. 1 open; none: not measured")
    digital: bool = Field(False, description="the output is on or off, and not analog")


class CabinetConfig(StrictModel):
    """The cabinet of one arm, which sends to a port of this computer."""

    address: str = Field("127.0.0.1", description="of the cabinet; nothing else is heard")
    port: int = Field(30200, ge=0, le=65535, description="of this computer, as the Sunrise project names it")
    version: Literal[1, 2] | None = Field(None, description="of FRI; none: as the cabinet's messages are")
    gripper: GripperIoConfig | None = Field(None, description="by inputs and outputs; none: not commanded")

    @field_validator("address")
    @classmethod
    def _is_address(cls, address: str) -> str:
        return str(ip_address(address))
