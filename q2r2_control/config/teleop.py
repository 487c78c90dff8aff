"""All settings of teleoperation, with units and ranges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from q2r2_control.config.bindings import BindingSettings
from q2r2_control.config.strict import STREAM_TIMEOUT, StrictModel
from q2r2_control.types import SIDES, Array, Interval

_Scale = Annotated[float, Field(ge=0, le=10)]
PRECISION_SCALE = 0.25  # Default of the setting ``precision_scale``.
_SIGNS = (("+", 1.0), ("-", -1.0))
_ALLOWED = "three of +x -x +y -y +z -z that use x, y and z once each, e.g. [+z, -x, +y]"


def axes_matrix(axes: Sequence[str]) -> Array:
    """Return the signed permutation M (3, 3) from the input's axes to the world's axes.

    A position p of the input becomes M p in the world, and a rotation R becomes M R M'. ``axes[i]`` is the input's axis
    that becomes the world's i-th axis. The determinant is -1 if the frame of the input is left-handed, as in raw Unity.
    Even then, M R M' is a proper rotation.

    Raises:
        ValueError: If the axes are not allowed. The message names the value and what is allowed.
    """
    rows = {sign + axis: factor * row for sign, factor in _SIGNS for axis, row in zip("xyz", np.eye(3), strict=True)}
    if any(axis not in rows for axis in axes) or sorted(axis[1] for axis in axes) != ["x", "y", "z"]:
        raise ValueError(f"axes {list(axes)} are not {_ALLOWED}")
    return np.array([rows[axis] for axis in axes])


class Stance(StrEnum):
    """Where the operator stands and looks. It decides which hand moves which arm."""

    # The operator looks in the same direction as the robot. The left hand moves the left arm.
    SIDE_BY_SIDE = "side_by_side"
    # The operator faces the robot. The left hand moves the right arm, and motions keep their direction in the world.
    MIRROR = "mirror"
    MIRROR_REFLECTED = "mirror_reflected"  # Like ``MIRROR``, but motions are reflected left to right.

    def hand_of(self, arm: str) -> str:
        """Return the hand that moves an arm."""
        return arm if self is Stance.SIDE_BY_SIDE else SIDES[1 - SIDES.index(arm)]


class RotationFrame(StrEnum):
    """The frame in which the hand's rotation is applied to the tool."""

    BASE = "base"
    TOOL = "tool"


class FilterSettings(StrictModel):
    """Interpolation between samples, then a One-Euro filter (Casiez, Roussel, Vogel, CHI 2012)."""

    interpolation_delay: float = Field(
        0.0165,
        ge=0.005,
        le=0.2,
        description="delay of the interpolation; the default is 1.25 periods of a 75 Hz headset [s]",
    )
    smoothing_delay: float = Field(0.0185, ge=0, le=0.2, description="delay of a motion at constant speed [s]")
    min_cutoff: float = Field(1.2, gt=0, le=100, description="cutoff frequency at rest; tremor is 8-12 Hz [Hz]")
    beta: float = Field(38.0, ge=0, le=1000, description="cutoff added per speed [Hz s/m]")
    rotation_beta: float = Field(9.0, ge=0, le=1000, description="cutoff added per speed [Hz s/rad]")
    derivative_cutoff: float = Field(1.45, gt=0, le=100, description="cutoff of the speed estimate [Hz]")

    @property
    def delay(self) -> float:
        """Delay from the receipt of a hand's sample to the output of the filter, at low frequencies [s]."""
        return self.interpolation_delay + self.smoothing_delay


class GateSettings(StrictModel):
    """Limits beyond which a hand sample moves no arm."""

    timeout: float = Field(
        STREAM_TIMEOUT, gt=0, le=2, description="an arm disengages if there was no pose for this time [s]"
    )
    max_jump: float = Field(0.15, gt=0, le=2, description="largest change of the position between two samples [m]")
    max_rotation_jump: float = Field(1.0, gt=0, le=3.14, description="largest rotation between two samples [rad]")
    max_speed: float = Field(5.0, gt=0, le=100, description="largest speed of a hand, over at least 50 ms [m/s]")
    max_angular_speed: float = Field(
        30.0, gt=0, le=100, description="largest angular speed of a hand, over at least 50 ms [rad/s]"
    )


class LeashSettings(StrictModel):
    """The largest distance of a target from its tool. A target that would be farther is held at this distance."""

    distance: float | None = Field(
        0.1, ge=0.02, le=2, description="largest distance of the positions [m]; null: no leash"
    )
    angle: float | None = Field(
        0.5, ge=0.1, le=2, description="largest angle between the rotations [rad]; null: no leash"
    )
    carried_distance: float = Field(
        0.03, ge=0.01, le=2, description="the same for the frame between two tools that carry one object [m]"
    )
    carried_angle: float = Field(0.1, ge=0.03, le=2, description="the same for the rotation of that frame [rad]")

    def carried(self) -> LeashSettings:
        """Return the leash of the frame between two tools that carry one object. A tool's leash is at least as long."""
        distance, angle = (math.inf if length is None else length for length in (self.distance, self.angle))
        shorter = {"distance": min(distance, self.carried_distance), "angle": min(angle, self.carried_angle)}
        return self.model_copy(update=shorter)


class HapticSettings(StrictModel):
    """Vibrations of the hand controllers."""

    strength: float = Field(1.0, ge=0, le=1, description="strength of all vibrations; 0: none")


class WorkspaceSettings(StrictModel):
    """A box in the world that one arm's targets stay in."""

    x: Interval = Field(description="smallest and largest position of the target [m]")
    y: Interval = Field(description="the same [m]")
    z: Interval = Field(description="the same [m]")

    @model_validator(mode="after")
    def _have_room(self) -> WorkspaceSettings:
        for name, (least, greatest) in (("x", self.x), ("y", self.y), ("z", self.z)):
            if not least < greatest:
                raise ValueError(f"{name} = [{least:g}, {greatest:g}]: allowed: least first")
        return self


class TeleopSettings(StrictModel):
    """Settings of the teleop layer; every range is checked when an instance is created."""

    stance: Stance = Field(Stance.SIDE_BY_SIDE, description="side_by_side, mirror or mirror_reflected")
    position_scale: float = Field(1.0, gt=0, le=10, description="tool metres per hand metre")
    rotation_scale: float = Field(1.0, ge=0, le=5, description="tool radians per hand radian")
    axis_scales: tuple[_Scale, _Scale, _Scale] = Field(
        (1.0, 1.0, 1.0), description="factors of motion along the world's x, y and z, multiplied by position_scale"
    )
    rotation_frame: RotationFrame = Field(RotationFrame.BASE, description="base or tool")
    axes: tuple[str, str, str] = Field(
        ("+x", "+y", "+z"),
        description="hand axes that become the world's x, y, z; e.g. [+z, -x, +y] for raw Unity (left-handed)",
    )
    chord_window: float = Field(
        0.08, ge=0, le=0.5, description="two buttons that are pressed within this time are a chord [s]"
    )
    hold_time: float = Field(
        0.6,
        ge=0.2,
        le=3,
        description="time after which a control counts as held, if its hold is bound to an action [s]",
    )
    linked: bool = Field(True, description="a fault of one hand disengages both arms")
    precision_scale: float = Field(
        PRECISION_SCALE, gt=0, le=1, description="factor of all motion while precision is held"
    )
    gripper_speed: float = Field(
        4.0,
        gt=0,
        le=50,
        description="speed of a gripper that follows gripper_analog, in full openings per second [1/s]",
    )
    workspace: dict[Literal["left", "right"], WorkspaceSettings] = Field(
        default_factory=dict, description="box of each arm by its name, in which its targets stay"
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


class GuardSettings(StrictModel):
    """Limits of a target's motion, whatever the hand does."""

    max_velocity: float = Field(0.5, gt=0, le=5, description="largest speed of the target's position [m/s]")
    max_acceleration: float = Field(
        5.0, gt=0, le=100, description="largest acceleration of the target's position [m/s^2]"
    )
    max_angular_velocity: float = Field(2.0, gt=0, le=20, description="largest speed of the target's rotation [rad/s]")
    max_angular_acceleration: float = Field(
        20.0, gt=0, le=400, description="largest acceleration of the target's rotation [rad/s^2]"
    )
