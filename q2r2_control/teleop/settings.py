"""Everything an operator tunes about teleoperation, with units and ranges."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field


class Stance(StrEnum):
    """Where the operator stands and which hand moves which arm."""

    SIDE_BY_SIDE = "side_by_side"  # beside the robot, facing the same way: left moves left
    MIRROR = "mirror"  # facing the robot: hands swapped, the room's axes kept
    MIRROR_REFLECTED = "mirror_reflected"  # hands swapped and the motion reflected left to right


class RotationFrame(StrEnum):
    """Frame in which the hand's rotation is applied to the tool."""

    BASE = "base"
    TOOL = "tool"


class FilterSettings(BaseModel):
    """One-Euro filter (Casiez, Roussel, Vogel, CHI 2012). Its delay at rest is about 1 / (2 pi min_cutoff)."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    min_cutoff: float = Field(3.0, gt=0, le=100, description="cutoff frequency at rest [Hz]")
    beta: float = Field(5.0, ge=0, le=1000, description="cutoff added per unit of speed [Hz s/m, Hz s/rad]")
    derivative_cutoff: float = Field(5.0, gt=0, le=100, description="cutoff of the speed estimate [Hz]")


class GateSettings(BaseModel):
    """What makes a hand sample unfit to move an arm."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    timeout: float = Field(0.15, gt=0, le=2, description="no pose for this long disengages [s]")
    max_jump: float = Field(0.15, gt=0, le=2, description="position change between two samples [m]")
    max_rotation_jump: float = Field(1.0, gt=0, le=3.14, description="rotation between two samples [rad]")


class TeleopSettings(BaseModel):
    """Settings of the teleop layer; every range is checked when the object is made."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    stance: Stance = Field(Stance.SIDE_BY_SIDE, description="side_by_side, mirror or mirror_reflected")
    position_scale: float = Field(1.0, gt=0, le=10, description="tool metres per hand metre")
    rotation_scale: float = Field(1.0, ge=0, le=5, description="tool radians per hand radian")
    rotation_frame: RotationFrame = Field(RotationFrame.BASE, description="base or tool")
    axes: tuple[str, str, str] = Field(
        ("+x", "+y", "+z"),
        description="hand axes that become the world's x, y, z; e.g. [+z, -x, +y] for raw Unity",
    )
    linked: bool = Field(True, description="a fault of one hand disengages both arms")
    filter: FilterSettings = Field(default_factory=FilterSettings)
    gate: GateSettings = Field(default_factory=GateSettings)
