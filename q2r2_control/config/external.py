"""The block ``external`` of a cell's YAML: other controllers that move its arms, and their ROS names."""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from q2r2_control.config.presets import BUILTIN, PRESETS, Mode, Preset, preset_called, preset_names, preset_of
from q2r2_control.config.strict import StrictModel
from q2r2_control.config.teleop import GuardSettings
from q2r2_control.errors import ConfigError

_NAME = re.compile(r"/?([A-Za-z_][A-Za-z0-9_]*)(/[A-Za-z_][A-Za-z0-9_]*)*")


def _ros_name(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError("allowed is a ROS name such as /robot/left_arm_controller, without / at its end")
    return name


def _absolute(name: str) -> str:
    if not name.startswith("/"):
        raise ValueError("allowed is a ROS name that begins with /, such as /robot/left_arm_controller")
    return name


RosName = Annotated[str, AfterValidator(_ros_name)]
AbsoluteName = Annotated[str, AfterValidator(_absolute), AfterValidator(_ros_name)]
FrameName = Annotated[str, Field(min_length=1, max_length=200, pattern=r"^\S+$")]


class ControllerKind(StrEnum):
    """The kind of controller that turns targets into the arms' motion."""

    BUILTIN = "builtin"
    EXTERNAL = "external"


class GripperType(StrEnum):
    """The ROS interface that moves a gripper."""

    GRIPPER_COMMAND = "GripperCommand"
    PARALLEL_GRIPPER_COMMAND = "ParallelGripperCommand"
    FLOAT64_MULTI_ARRAY = "Float64MultiArray"


class GripperSettings(StrictModel):
    """The gripper of an arm, and the goals that open and close it."""

    action_type: GripperType = Field(
        GripperType.GRIPPER_COMMAND, description="GripperCommand, ParallelGripperCommand or Float64MultiArray"
    )
    open_position: float = Field(0.0, ge=-3.15, le=3.15, description="goal that opens [m or rad]")
    closed_position: float = Field(0.05, ge=-3.15, le=3.15, description="goal that closes [m or rad]")
    max_effort: float = Field(5.0, ge=0, le=500, description="largest effort of a goal [N or Nm]")
    joint_name: str = Field("", description="joint of a ParallelGripperCommand")

    @model_validator(mode="after")
    def _opens(self) -> GripperSettings:
        if self.open_position == self.closed_position:
            raise ValueError(f"open_position and closed_position have to differ, both are {self.open_position:g}")
        return self


class ExternalGripper(GripperSettings):
    """The gripper of an arm that an external controller moves, and the gripper's action or topic."""

    topic: RosName | None = Field(
        None, description="action or topic of the gripper; null: /q2r2/left_gripper/gripper_cmd"
    )

    def settings(self) -> GripperSettings:
        """Return the settings without the topic."""
        return GripperSettings(**self.model_dump(exclude={"topic"}))


class GuardLimits(StrictModel):
    """Limits of the target's motion. If a limit is null, the limit of the preset is used."""

    max_velocity: float | None = Field(None, gt=0, le=5, description="largest speed of the target's position [m/s]")
    max_acceleration: float | None = Field(
        None, gt=0, le=100, description="largest acceleration of the target's position [m/s^2]"
    )
    max_angular_velocity: float | None = Field(
        None, gt=0, le=20, description="largest speed of the target's rotation [rad/s]"
    )
    max_angular_acceleration: float | None = Field(
        None, gt=0, le=400, description="largest acceleration of the target's rotation [rad/s^2]"
    )

    def over(self, guard: GuardSettings) -> GuardSettings:
        """Return a copy of ``guard`` in which each limit is the limit of this instance, unless that limit is None."""
        return guard.model_copy(update=self.model_dump(exclude_none=True))


class ExternalArm(StrictModel):
    """The external controller of one arm: its ROS names and frames."""

    ctrl_prefix: AbsoluteName = Field(description="name of the controller's node, with its namespace")
    base_frame: FrameName = Field(description="frame_id of its targets; a frame of /tf")
    tool_frame: FrameName | None = Field(
        None,
        description="frame of /tf that the operator moves, in mode filtered at the cell's tool; null: the cell's tool",
    )
    target_topic: RosName | None = Field(
        None, description="topic of the targets or joint commands; null: that of the preset"
    )
    joint_states_topic: RosName = Field("joint_states", description="topic of the arm's joint states")
    gripper: ExternalGripper = ExternalGripper()


_EXTERNAL = tuple(name for name in PRESETS if name != BUILTIN.name)


class ExternalConfig(StrictModel):
    """The controller that drives the arms instead of the built-in one, and the messages that it gets."""

    preset: str = Field(description=f"kind of the controller: {', '.join(_EXTERNAL)}, or an installed preset")
    mode: Mode = Field(
        Mode.FILTERED,
        description="filtered: what the built-in controller makes of the hand's target; raw: that target itself",
    )
    rate: float | None = Field(
        None, ge=1, le=1000, description="rate of the messages that the controller gets [Hz]; null: that of the preset"
    )
    world_frame: FrameName | None = Field(
        None,
        description="frame of /tf that is the world frame of the cell, and whose axes the hands use; null: base_frame",
    )
    limits: GuardLimits = GuardLimits()
    arms: dict[Literal["left", "right"], ExternalArm] = Field(min_length=1)

    @field_validator("preset")
    @classmethod
    def _is_known(cls, name: str) -> str:
        allowed = [one for one in preset_names() if one != BUILTIN.name]
        if name not in allowed:
            raise ValueError(f"allowed are {', '.join(allowed)}")
        return name

    @model_validator(mode="after")
    def _fits_the_preset(self) -> ExternalConfig:
        try:
            preset, _ = preset_of(self.preset, self.mode)
        except ConfigError as error:
            raise ValueError(str(error)) from error
        if self.rate is not None and self.rate < preset.lowest_rate:
            raise ValueError(f"rate = {self.rate:g}: preset {preset.name} needs at least {preset.lowest_rate:g} Hz")
        if not preset.takes_targets and (given := [key for key, value in self.limits if value is not None]):
            gets = "gets joint positions within the limits of the block control"
            raise ValueError(f"limits.{given[0]}: is for targets; preset {preset.name} {gets}")
        return self

    @property
    def terms(self) -> Preset:
        """The preset of the controller."""
        return preset_called(self.preset)

    @property
    def filtered(self) -> bool:
        """Whether the built-in controller computes the external controller's targets from the hands' targets."""
        return self.mode is Mode.FILTERED

    def topic(self, arm: str) -> str:
        """Return the topic of an arm's targets or joint commands."""
        made = self.arm(arm)
        return made.target_topic or self.terms.topic_of(made.ctrl_prefix)

    def arm(self, name: str) -> ExternalArm:
        """Return the settings of one arm's controller."""
        return next(arm for side, arm in self.arms.items() if side == name)


def check_external(kind: ControllerKind, external: ExternalConfig | None, arms: Iterable[str]) -> None:
    """Raise :class:`ConfigError` unless ``external`` has all arms, or is None with the built-in controller."""
    if kind is ControllerKind.BUILTIN:
        if external is not None:
            raise ConfigError("external: allowed with controller: external only")
        return
    if external is None:
        raise ConfigError("controller = 'external': needs the block external, with preset and arms")
    if missing := set(arms) - set(external.arms):
        raise ConfigError(f"external.arms: without {', '.join(sorted(missing))}; needed: {', '.join(arms)}")
    if surplus := set(external.arms) - set(arms):
        raise ConfigError(f"external.arms.{sorted(surplus)[0]}: the cell has no such arm; allowed: {', '.join(arms)}")
    # No two arms may have the same topic, because each arm would then get the targets of both in turn.
    topics = [external.topic(arm) for arm in external.arms]
    frames = [made.tool_frame for made in external.arms.values() if made.tool_frame is not None]
    for what, values in (("commands", topics), ("tool_frame", frames)):
        if len(set(values)) < len(values):
            raise ConfigError(f"external.arms: both have {what} {values[0]}; allowed: one of its own for each arm")


def describe(external: ExternalConfig) -> dict[str, str]:
    """Return, for each arm, one line about its controller."""
    preset = external.terms
    source = "what the built-in controller makes of the hand's target" if external.filtered else "the hand's target"
    lines: dict[str, str] = {}
    for arm, made in external.arms.items():
        message = preset.message.rpartition("/")[2] + (f" in {made.base_frame}" if preset.takes_targets else "")
        rate = external.rate or preset.rate
        lines[arm] = f"{preset.name}: {message} on {external.topic(arm)} at {rate:g} Hz, {source}"
        lines[arm] += f"; it takes: {preset.activation.format(ctrl=made.ctrl_prefix)}"
    return lines
