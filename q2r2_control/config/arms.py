"""Settings of robots and arms: models, mounts, tools, grippers, home postures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, model_validator

from q2r2_control.config.strict import StrictModel
from q2r2_control.errors import ConfigError

Side = Literal["left", "right"]
# The ranges detect values that were written in millimetres or degrees by mistake.
Coordinate = Annotated[float, Field(ge=-20, le=20)]  # [m]
Extent = Annotated[float, Field(gt=0, le=20)]  # [m]
Angle = Annotated[float, Field(ge=-6.2832, le=6.2832)]  # [rad]
ObjectSize = Annotated[float, Field(ge=0.001, le=1)]  # [m]
Acceleration = Annotated[float, Field(gt=0, le=100)]  # [rad/s^2]
Share = Annotated[float, Field(ge=0, le=1)]
Metres3 = Annotated[tuple[Coordinate, Coordinate, Coordinate], Field(description="x, y, z [m]")]
Radians3 = Annotated[tuple[Angle, Angle, Angle], Field(description="roll, pitch, yaw [rad]")]
Colour = tuple[Share, Share, Share, Share]
_USUAL_RADIUS = 0.03  # Default radius of a held object: more than half the opening of most grippers [m].


def _beside_the_file(value: str, info: ValidationInfo) -> str:
    """Return the path of the file ``value`` in the folder of the YAML; if there is no such file, return ``value``."""
    folder: Path | None = (info.context or {}).get("folder")
    # If a model has no file ending, it is the name of a file robots/NAME.urdf.
    path = f"robots/{value}.urdf" if info.field_name == "model" and not Path(value).suffix else value
    try:
        return str(folder / path) if folder is not None and value and (folder / path).exists() else value
    except (OSError, ValueError):  # No file can have this name. The code that reads the file will report this.
        return value


def _by_joint(value: object) -> object:
    """Refuse a list or a number here, because pydantic's own message would name a type that does not exist in YAML."""
    if not isinstance(value, Mapping):
        raise ValueError("allowed: limits by joint, such as {A2: 5.4}")
    return value


# A path is looked up from the folder of the YAML first, then from the working directory, then among the shipped files.
LocalPath = Annotated[str, AfterValidator(_beside_the_file)]
XacroArgs = Annotated[dict[str, str | bool | int | float], Field(description="arguments of a .xacro model, by name")]


class PoseConfig(StrictModel):
    """A fixed pose in the parent frame."""

    position: Metres3 = (0.0, 0.0, 0.0)
    rpy: Radians3 = (0.0, 0.0, 0.0)


class FlangeConfig(StrictModel):
    """The flange between an arm's last link and its tool: a model, or a cylinder. By default, there is no flange."""

    model: LocalPath | None = Field(None, description="a file of robots/ without .urdf, or a path")
    xacro_args: XacroArgs = Field({})
    frame: str | None = Field(None, description="link of the model that carries the tool; default: the last link")
    thickness: float | None = Field(
        None, gt=0, le=0.5, description="length along z of a cylinder that is used instead of a model [m]"
    )
    radius: float | None = Field(None, gt=0, le=0.5, description="radius of that cylinder [m]")
    mass: float = Field(0.0, ge=0, le=20, description="mass of that cylinder [kg]")

    @model_validator(mode="after")
    def _is_one_thing(self) -> FlangeConfig:
        if (self.thickness is None) != (self.radius is None):
            raise ValueError("thickness and radius describe a cylinder together: give both")
        if self.model is not None and (self.thickness is not None or self.mass):
            raise ValueError("a model has its own thickness, radius and mass: give the model or those")
        if self.model is None and (self.frame is not None or self.xacro_args):
            raise ValueError("frame and xacro_args are those of a model: give it as well")
        if self.mass and self.thickness is None:
            raise ValueError("mass is that of a cylinder: give its thickness and radius as well")
        return self

    @property
    def is_none(self) -> bool:
        """Whether there is no flange, so that the tool is mounted on the arm's last link."""
        return self.model is None and self.thickness is None


class ToolConfig(StrictModel):
    """The tool on an arm's last link or flange."""

    model: LocalPath | None = Field(None, description="a file of robots/ without .urdf, or a path; none: bare flange")
    xacro_args: XacroArgs = Field({})
    link: str | None = Field(None, description="arm link that carries the tool; default: the arm's tip")
    mount: PoseConfig = PoseConfig()
    frame: str | None = Field(None, description="link of the tool that the operator moves; default: the last link")


class HeldObjectConfig(StrictModel):
    """The object that a gripper holds: a box or a ball, fixed to the tool."""

    box: tuple[ObjectSize, ObjectSize, ObjectSize] | None = Field(None, description="x y z [m]")
    sphere: float | None = Field(
        None, gt=0, le=0.5, description="radius [m]; 0.03 if neither a box nor a sphere is given"
    )
    at: Metres3 = Field((0.0, 0.0, 0.0), description="centre in the tool frame [m]")
    rpy: Radians3 = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw of the box in the tool frame [rad]")
    mass: float = Field(0.0, ge=0, le=50, description="mass that torque mode compensates [kg]")

    @model_validator(mode="after")
    def _is_one_shape(self) -> HeldObjectConfig:
        if self.box is not None and self.sphere is not None:
            raise ValueError("box and sphere are two shapes: give one")
        return self

    @property
    def radius(self) -> float:
        """The radius of the object if it is a ball, and not a box [m]."""
        return _USUAL_RADIUS if self.sphere is None else self.sphere


class GripperConfig(StrictModel):
    """The finger joints of a gripper, and their positions when it is open and closed."""

    joints: tuple[str, ...] = Field((), description="finger joints of the tool, all driven alike")
    open_position: float = Field(
        0.0, ge=-3.15, le=3.15, description="position of each finger joint of the open gripper [m or rad]"
    )
    closed_position: float = Field(
        0.0, ge=-3.15, le=3.15, description="position of each finger joint of the closed gripper [m or rad]"
    )
    speed: float = Field(0.1, gt=0, le=5, description="speed of each finger joint [m/s or rad/s]")
    force: float = Field(60.0, gt=0, le=500, description="force of each finger joint [N or Nm]")
    object: HeldObjectConfig | None = Field(
        None, description="the object that counts as a part of the tool while the gripper holds it"
    )

    @model_validator(mode="after")
    def _opens(self) -> GripperConfig:
        if self.joints and self.open_position == self.closed_position:
            raise ValueError(f"open_position and closed_position have to differ, both are {self.open_position:g}")
        return self


class RobotConfig(StrictModel):
    """One model that several arms are parts of. Its links and joints keep their names."""

    model: LocalPath = Field(description="the model, named as an arm's model is")
    xacro_args: XacroArgs = Field({})
    mount: PoseConfig = PoseConfig()
    home: dict[str, float] = Field(
        default_factory=dict,
        description="positions at which joints of no arm are locked, by name; the default is as near to 0 as allowed",
    )


class ArmConfig(StrictModel):
    """One arm: its tip, tool and home posture. An arm that is not part of ``robot`` also has a model and a mount."""

    model: LocalPath | None = Field(
        None, description="a file of robots/ without .urdf, example-robot-data:NAME, or a path"
    )
    xacro_args: XacroArgs = Field({})
    mount: PoseConfig = PoseConfig()
    tip: str | None = Field(None, description="last link of the arm; null: it is found if only one link is possible")
    joints: tuple[str, ...] = Field(
        (), description="joints of the arm from base to tip; null: all joints from base to tip"
    )
    flange: FlangeConfig = FlangeConfig()
    tool: ToolConfig = ToolConfig()
    gripper: GripperConfig = GripperConfig()
    home: tuple[float, ...] = Field(description="joint positions [rad]")
    acceleration_limit: Annotated[dict[str, Acceleration], BeforeValidator(_by_joint)] = Field(
        default_factory=dict,
        description="acceleration limits of joints by name, in place of those of the model [rad/s^2]",
    )

    @model_validator(mode="after")
    def _has_one_tip(self) -> ArmConfig:
        named = {"tool.link": self.tool.link}
        if self.tool.model is None:
            named["tool.frame"] = self.tool.frame
        for key, link in named.items():
            if self.tip is not None and link not in (None, self.tip):
                raise ValueError(f"tip = {self.tip!r:.60} and {key} = {link!r:.60} mean the same link: give one")
        if self.tool.frame is not None and self.tool.model is None and not self.flange.is_none:
            raise ValueError(
                f"tool.frame = {self.tool.frame!r:.60}: without a tool the end of the flange is what moves; "
                "the arm's link that carries the flange is named by tip"
            )
        return self

    @property
    def named_tip(self) -> str | None:
        """The arm's last link; None if the file does not name it."""
        return self.tip or self.tool.link


def check_models(robot: RobotConfig | None, arms: Mapping[Side, ArmConfig]) -> None:
    """Raise :class:`ConfigError` unless every arm has a model of its own, or all are parts of ``robot``."""
    for side, arm in arms.items():
        key = f"arms.{side}"
        if robot is None and arm.model is None:
            raise ConfigError(f"{key}.model: missing; give one, or the key robot: a model that all arms are parts of")
        for part in ("model", "xacro_args", "mount"):
            if robot is not None and part in arm.model_fields_set:
                raise ConfigError(f"{key}.{part}: an arm of robot has none; set robot.{part}")
