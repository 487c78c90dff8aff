"""The YAML of a cell as pydantic models. :func:`.cell_file.load_config` reads a file.

Every key has a unit and a range here. The file ``config/dual_iiwa7.yaml`` shows all keys with comments.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, Tag, field_validator, model_validator

from q2r2_control.config.arms import (
    ArmConfig,
    Colour,
    Coordinate,
    Extent,
    LocalPath,
    Metres3,
    Radians3,
    RobotConfig,
    Side,
    check_models,
)
from q2r2_control.config.bindings import Action
from q2r2_control.config.control import (
    AdmittanceSettings,
    ControllerSettings,
    ImpedanceSettings,
    SupervisionSettings,
    check_priority,
)
from q2r2_control.config.external import ControllerKind, ExternalConfig, check_external
from q2r2_control.config.fri import MODBUS_DELAY, CabinetConfig, ModbusGripperConfig
from q2r2_control.config.recording import CameraConfig, CameraName, JudgeSettings, RecordingSettings
from q2r2_control.config.strict import Network, StrictModel, network_of
from q2r2_control.config.teleop import TeleopSettings

# With this value of ``loop_rate_hz``, the loop's rate is chosen when a run in real time begins.
AUTO: Literal["auto"] = "auto"
HIGHEST_FITTING_RATE_HZ = 1000.0


def _only_auto(value: object) -> object:
    if value != AUTO:
        raise ValueError(f"allowed: {AUTO}, or 50 to 2000 [Hz]")
    return value


_LoopRate = Annotated[
    Annotated[float, Field(ge=50, le=2000), Tag("[number]")]
    | Annotated[Literal["auto"], BeforeValidator(_only_auto), Tag("[word]")],
    Discriminator(lambda value: "[word]" if isinstance(value, str) else "[number]"),
]


class ObstacleConfig(StrictModel):
    """A fixed body of the cell. The axis of a cylinder or capsule is z.

    The length of a capsule is the length of its axis between the centres of its two half balls.
    """

    shape: Literal["box", "cylinder", "sphere", "capsule"]
    size: tuple[Extent, ...] = Field(
        description="box: x y z; cylinder, capsule: radius length; sphere: radius [m]", min_length=1, max_length=3
    )
    position: Metres3 = (0.0, 0.0, 0.0)
    rpy: Radians3 = (0.0, 0.0, 0.0)
    colour: Colour = (0.55, 0.45, 0.35, 1.0)

    @model_validator(mode="after")
    def _size_fits_shape(self) -> ObstacleConfig:
        count = {"box": 3, "cylinder": 2, "sphere": 1, "capsule": 2}[self.shape]
        if len(self.size) != count:
            raise ValueError(f"a {self.shape} takes {count} size value(s), got {list(self.size)}")
        return self


class HeadsetConfig(StrictModel):
    """The TCP server that the Quest2ROS app connects to."""

    host: str = Field("127.0.0.1", description="address to bind; 0.0.0.0 admits the network, :: also that of IPv6")
    port: int = Field(10000, ge=0, le=65535, description="port of the server; 0: any free port")
    allow: tuple[str, ...] | None = Field(
        None, min_length=1, description="addresses and networks that may connect; null: all that reach the port"
    )
    frozen_time: float | None = Field(
        0.5,
        ge=0.1,
        le=10,
        description="a hand whose poses are equal to the last bit for this time is lost [s]; null: no such rule",
    )
    watch_frame: bool = Field(
        True, description="a motion of both hands as one rigid body is a fault, since the tracking frame has moved"
    )

    @field_validator("allow")
    @classmethod
    def _are_networks(cls, allow: tuple[str, ...] | None) -> tuple[str, ...] | None:
        for text in allow or ():
            network_of(text)
        return allow

    @property
    def networks(self) -> tuple[Network, ...] | None:
        """The IP networks that the key ``allow`` lists."""
        return None if self.allow is None else tuple(map(network_of, self.allow))


class BoxConfig(StrictModel):
    """A box of a loose object, in addition to the object's first box."""

    size: tuple[Extent, Extent, Extent] = Field(description="x y z [m]")
    at: Metres3 = Field(description="centre, relative to that of the first box [m]")


class ObjectConfig(StrictModel):
    """A loose box in the simulated cell, to be grasped. The controller does not know this box."""

    size: tuple[Extent, Extent, Extent] = Field(description="x y z [m]")
    position: Metres3 = Field(description="position of the centre at the start [m]")
    mass: float = Field(0.2, gt=0, le=100, description="mass of the whole object [kg]")
    boxes: tuple[BoxConfig, ...] = Field(
        (), description="further boxes that are fixed to the object, such as the walls of a hole"
    )
    friction: float = Field(
        1.0, ge=0, le=1.5, description="friction against other objects; pads and obstacles have their own"
    )
    stiffness: float | None = Field(
        None, ge=100, le=1e5, description="stiffness of a soft object on an obstacle [N/m]; null: as hard as wood"
    )
    colour: Colour = (0.2, 0.45, 0.8, 1.0)


class MujocoConfig(StrictModel):
    """The simulated cell."""

    timestep: float = Field(0.001, gt=0, le=0.001, description="physics step [s]")
    position_stiffness: float = Field(4000.0, gt=0, le=1e6, description="stiffness of the position servos [Nm/rad]")
    position_damping_ratio: float = Field(1.0, gt=0, le=5, description="damping ratio of the position servos")
    rotor_share: float = Field(
        1.0,
        ge=0.01,  # The simulation of light wrist joints without any rotor inertia would be unstable.
        le=1,
        description="share of the rotors' inertia that the joints feel; a torque loop at the joint hides most of it",
    )
    obstacle_friction: float = Field(
        0.6,
        ge=0,
        le=1.5,
        description="friction of bodies that touch obstacles; metal on wood has 0.3, rubber on wood up to 0.9",
    )
    objects: dict[str, ObjectConfig] = Field(default_factory=dict, description="loose boxes by name")


class Config(StrictModel):
    """One cell: everything a user tunes."""

    name: str = Field(min_length=1)
    robot: RobotConfig | None = Field(
        None, description="a model that contains all arms; null if each arm has a model of its own"
    )
    arms: dict[Side, ArmConfig] = Field(min_length=1)
    packages: dict[str, LocalPath] = Field(
        default_factory=dict, description="folder of each ROS package by its name, for package:// and $(find ...)"
    )
    obstacles: dict[str, ObstacleConfig] = Field(default_factory=dict)
    floor: Coordinate | None = Field(
        0.0, description="height of the floor, from which the arms keep their distance [m]; null: no floor"
    )
    srdf: LocalPath | None = Field(
        None, description="SRDF file of the pairs that are not monitored, as q2r2 check --pairs writes it"
    )
    capsules: dict[str, Annotated[int, Field(ge=1, le=4)]] = Field(
        default_factory=dict,
        description="largest number of capsules that enclose each collision mesh of a link, or each drawing of a link "
        "without a collision shape; other links: one",
    )
    unchecked_links: tuple[str, ...] = Field(
        (), description="links without a collision shape that are not monitored at all"
    )
    supervision: SupervisionSettings = SupervisionSettings()
    loop_rate_hz: _LoopRate = Field(
        AUTO, description="control loop [Hz]; auto: the highest of 1000, 500 and 250 that this computer can keep"
    )
    input: str = Field("scripted", min_length=1, description="input device, if no --input is given")
    input_settings: dict[str, dict[str, Any]] = Field(
        {}, description="settings of inputs of other packages, by their entry point's name; each checks its own"
    )
    plant: str = Field("mujoco", min_length=1, description="plant, if no --plant is given")
    plant_settings: dict[str, dict[str, Any]] = Field(
        {}, description="settings of plants of other packages, by their entry point's name; each checks its own"
    )
    controller: ControllerKind = Field(ControllerKind.BUILTIN, description="builtin, or external: for q2r2 ros up")
    external: ExternalConfig | None = Field(
        None, description="controllers of other packages; only with controller: external"
    )
    control: ControllerSettings = ControllerSettings()
    impedance: ImpedanceSettings = ImpedanceSettings()
    admittance: AdmittanceSettings = AdmittanceSettings()
    teleop: TeleopSettings = TeleopSettings()
    headset: HeadsetConfig = HeadsetConfig()
    mujoco: MujocoConfig = MujocoConfig()
    fri: dict[Side, CabinetConfig] = Field(
        default_factory=dict, description="the KUKA cabinet of each arm, for plant fri"
    )
    cameras: dict[CameraName, CameraConfig] = Field(
        default_factory=dict,
        max_length=16,
        description="cameras of the simulated cell, on ROS topics, or devices of this computer, by name",
    )
    recording: RecordingSettings = RecordingSettings()
    judge: JudgeSettings = JudgeSettings()

    @model_validator(mode="after")
    def _fits_together(self) -> Config:
        check_models(self.robot, self.arms)
        check_priority(self.control.priority, self.arms)
        check_external(self.controller, self.external, self.arms)
        return self

    @property
    def simulated_cameras(self) -> dict[str, CameraConfig]:
        """The cameras of the simulated cell, by name. All other cameras are real: on ROS topics or devices."""
        return {name: camera for name, camera in self.cameras.items() if camera.is_simulated}

    @property
    def device_cameras(self) -> dict[str, CameraConfig]:
        """The real cameras that this computer opens itself, by name."""
        return {name: camera for name, camera in self.cameras.items() if camera.device is not None}

    @property
    def nominal_rate_hz(self) -> float:
        """The rate of the loop [Hz]. While it is ``auto``, this is the highest rate that may be chosen."""
        return HIGHEST_FITTING_RATE_HZ if self.loop_rate_hz == AUTO else float(self.loop_rate_hz)

    @property
    def gripper_delay(self) -> float:
        """Time within which a gripper on Modbus gets its newest command and is measured, plus a few ticks [s].

        It is 0 if no gripper is on Modbus.
        """
        by_modbus = any(isinstance(cabinet.gripper, ModbusGripperConfig) for cabinet in self.fri.values())
        return MODBUS_DELAY if by_modbus else 0.0

    @property
    def note_on_grippers(self) -> str | None:
        """A line about a control that is bound to a gripper if no arm has a gripper; None otherwise."""
        analog = self.teleop.bindings.words_of(Action.GRIPPER_ANALOG)
        moved = any(arm.gripper.joints for arm in self.arms.values()) or any(cell.gripper for cell in self.fri.values())
        if analog is None or moved or self.controller is ControllerKind.EXTERNAL:
            return None
        return f"teleop.bindings: {analog} is gripper_analog, but no arm has a gripper; allowed: arms.*.gripper.joints"

    def model_of(self, arm: str) -> str:
        """Return the model of an arm, or the robot model of which the arm is a part."""
        part_of = self.robot or next(made for side, made in self.arms.items() if side == arm)
        return part_of.model or ""

    def named_tool_frame(self, arm: str) -> str | None:
        """Return the link that the operator moves, by its name in the whole cell; None if the YAML does not name it."""
        made = next(made for side, made in self.arms.items() if side == arm)
        if made.tool.model is not None:
            return None if made.tool.frame is None else f"{arm}_{made.tool.frame}"
        if not made.flange.is_none:
            return None
        frame = made.tool.frame or made.named_tip
        return frame if frame is None or self.robot is not None else f"{arm}_{frame}"
