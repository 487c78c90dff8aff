"""Everything an operator tunes about teleoperation, with units and ranges."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from q2r2_control.config.axes import axes_matrix
from q2r2_control.config.bindings import BindingSettings
from q2r2_control.config.timeouts import STREAM_TIMEOUT
from q2r2_control.types import Interval

_Scale = Annotated[float, Field(ge=0, le=10)]


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
    """Interpolation between samples, then a One-Euro filter (Casiez, Roussel, Vogel, CHI 2012).

    The hand's delay is interpolation_delay + smoothing_delay, at any speed.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    interpolation_delay: float = Field(0.02, ge=0.005, le=0.2, description="1.5 periods of a 75 Hz headset [s]")
    smoothing_delay: float = Field(0.025, ge=0, le=0.2, description="of a motion at constant speed [s]")
    min_cutoff: float = Field(1.5, gt=0, le=100, description="cutoff frequency at rest; tremor is 8-12 Hz [Hz]")
    beta: float = Field(10.0, ge=0, le=1000, description="cutoff added per speed [Hz s/m]")
    rotation_beta: float = Field(3.0, ge=0, le=1000, description="cutoff added per speed [Hz s/rad]")
    derivative_cutoff: float = Field(2.0, gt=0, le=100, description="cutoff of the speed estimate [Hz]")
    average_at_rest: bool = Field(True, description="a hand that rests is where its samples are on average")


class GateSettings(BaseModel):
    """Limits beyond which a hand sample moves no arm."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    timeout: float = Field(STREAM_TIMEOUT, gt=0, le=2, description="no pose for this long disengages [s]")
    max_jump: float = Field(0.15, gt=0, le=2, description="position change between two samples [m]")
    max_rotation_jump: float = Field(1.0, gt=0, le=3.14, description="rotation between two samples [rad]")
    max_speed: float = Field(5.0, gt=0, le=100, description="of a hand, over at least 50 ms [m/s]")
    max_angular_speed: float = Field(30.0, gt=0, le=100, description="of a hand, over at least 50 ms [rad/s]")


class LeashSettings(BaseModel):
    """How far a target may be from its tool; beyond that it slips along. None: as far as the hand goes."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    distance: float | None = Field(0.1, ge=0.02, le=2, description="of positions [m]; none: no leash")
    angle: float | None = Field(0.5, ge=0.1, le=2, description="of rotations [rad]; none: no leash")
    carried_distance: float = Field(0.03, ge=0.01, le=2, description="of the frame between two tools that carry [m]")
    carried_angle: float = Field(0.1, ge=0.03, le=2, description="of that frame's rotation [rad]")

    def carried(self) -> LeashSettings:
        """The leash of the frame between two tools, which is no longer than that of a tool."""
        distance, angle = (math.inf if length is None else length for length in (self.distance, self.angle))
        shorter = {"distance": min(distance, self.carried_distance), "angle": min(angle, self.carried_angle)}
        return self.model_copy(update=shorter)


class HapticSettings(BaseModel):
    """Vibrations of the hand controllers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    strength: float = Field(1.0, ge=0, le=1, description="of all vibrations; 0: none")


class WorkspaceSettings(BaseModel):
    """A box in the world that one arm's targets stay in."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    x: Interval = Field(description="least and greatest of the target's position [m]")
    y: Interval = Field(description="the same [m]")
    z: Interval = Field(description="the same [m]")
    soft_edge: float = Field(0.05, gt=0, le=0.5, description="this near to a side the target slows down [m]")

    @model_validator(mode="after")
    def _have_room(self) -> WorkspaceSettings:
        for name, (least, greatest) in (("x", self.x), ("y", self.y), ("z", self.z)):
            if not greatest - least >= 2.0 * self.soft_edge:
                raise ValueError(
                    f"{name} = [{least:g}, {greatest:g}]: allowed: least first, and twice soft_edge in between, "
                    f"{2.0 * self.soft_edge:g} m"
                )
        return self


class SpeedLimitSettings(BaseModel):
    """How fast one arm's target may move, however fast the hand does. None: as fast as the hand."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    linear: float | None = Field(None, ge=0.01, le=5, description="of the target's position [m/s]")
    angular: float | None = Field(None, ge=0.05, le=20, description="of the target's rotation [rad/s]")


class TeleopSettings(BaseModel):
    """Settings of the teleop layer; every range is checked when the object is made."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    stance: Stance = Field(Stance.SIDE_BY_SIDE, description="side_by_side, mirror or mirror_reflected")
    position_scale: float = Field(1.0, gt=0, le=10, description="tool metres per hand metre")
    rotation_scale: float = Field(1.0, ge=0, le=5, description="tool radians per hand radian")
    axis_scales: tuple[_Scale, _Scale, _Scale] = Field(
        (1.0, 1.0, 1.0), description="of motion along the world's x, y and z, on top of position_scale"
    )
    rotation_frame: RotationFrame = Field(RotationFrame.BASE, description="base or tool")
    axes: tuple[str, str, str] = Field(
        ("+x", "+y", "+z"),
        description="hand axes that become the world's x, y, z; e.g. [+z, -x, +y] for raw Unity (left-handed)",
    )
    chord_window: float = Field(
        0.08, ge=0, le=0.5, description="a button waits this long for the other, which makes it a chord [s]"
    )
    hold_time: float = Field(
        0.6, ge=0.2, le=3, description="after which a control counts as held, where that is bound [s]"
    )
    double_tap_window: float = Field(
        0.3, ge=0.1, le=1, description="a tap waits this long for another, where two are bound [s]"
    )
    linked: bool = Field(True, description="a fault of one hand disengages both arms")
    precision_scale: float = Field(0.25, gt=0, le=1, description="of all motion while precision is held")
    gripper_speed: float = Field(
        4.0, gt=0, le=50, description="of a gripper that is gripper_analog, in full openings a second [1/s]"
    )
    workspace: dict[Literal["left", "right"], WorkspaceSettings] = Field(
        default_factory=dict, description="arm -> box that its targets stay in"
    )
    speed_limit: dict[Literal["left", "right"], SpeedLimitSettings] = Field(
        default_factory=dict, description="arm -> how fast its targets may move"
    )
    bindings: BindingSettings = Field(default_factory=BindingSettings)
    filter: FilterSettings = Field(default_factory=FilterSettings)
    leash: LeashSettings = Field(default_factory=LeashSettings)
    haptics: HapticSettings = Field(default_factory=HapticSettings)
    gate: GateSettings = Field(default_factory=GateSettings)

    @field_validator("axes")
    @classmethod
    def _axes_are_a_signed_permutation(cls, axes: tuple[str, str, str]) -> tuple[str, str, str]:
        axes_matrix(axes)
        return axes


class GuardSettings(BaseModel):
    """How fast a target may move, whatever the hand does."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    max_velocity: float = Field(0.5, gt=0, le=5, description="of the target's position [m/s]")
    max_acceleration: float = Field(5.0, gt=0, le=100, description="of the target's position [m/s^2]")
    max_angular_velocity: float = Field(2.0, gt=0, le=20, description="of the target's rotation [rad/s]")
    max_angular_acceleration: float = Field(20.0, gt=0, le=400, description="of the target's rotation [rad/s^2]")
