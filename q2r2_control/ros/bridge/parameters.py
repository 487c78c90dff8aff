"""The parameters of an arm controller, and the conversion of any settings model into parameters of a node."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.external import GripperSettings, GuardLimits
from q2r2_control.config.presets import BUILTIN, Mode, Preset, preset_of
from q2r2_control.config.strict import STREAM_TIMEOUT, Model, validated
from q2r2_control.config.teleop import GuardSettings, Stance, TeleopSettings
from q2r2_control.errors import ConfigError
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.types import QUEST_CONTROLS


@dataclass(frozen=True, slots=True)
class ArmDefaults:
    """The defaults of an arm's parameters, from the constructor of :class:`BaseArmController` or from the cell."""

    arm_name: str  # "left" or "right".
    ctrl_prefix: str
    base_frame_id: str
    end_effector_link_name: str
    gripper_action_topic: str
    teleop: TeleopSettings
    preset: str = BUILTIN.name
    mode: Mode = Mode.RAW
    rate: float | None = None
    target_topic: str = ""
    world_frame_id: str = ""
    gripper: GripperSettings = field(default_factory=GripperSettings)
    limits: GuardLimits = field(default_factory=GuardLimits)


@dataclass(frozen=True, slots=True)
class ArmParameters:
    """The checked parameters of an arm controller."""

    base_frame: str  # The frame of the controller's targets.
    # A hand's motion along an axis of the input's frame moves the tool along the same axis of this frame.
    world_frame: str
    tool_frame: str
    controller: str  # The name of the controller's node.
    prefix: str  # The text for {ctrl} in the preset.
    target_topic: str
    current_pose_topic: str  # The topic of the tool pose; "" if the pose comes from /tf.
    builtin_node: str  # The name of the built-in controller's node.
    builtin_prefix: str
    tool_timeout: float  # Greatest age of the tool pose and of the safe target [s].
    listener_timeout: float  # Longest time without acknowledgements of the controller [s].
    rate: float  # Rate of targets [Hz].
    preset: Preset
    mode: Mode
    gripper_topic: str
    gripper: GripperSettings
    guard: GuardSettings
    teleop: TeleopSettings


def arm_parameters(node: BaseNode, given: ArmDefaults) -> ArmParameters:
    """Declare all parameters and check them together; raises :class:`ConfigError`.

    If the parameter ``config`` names a cell, the defaults are the cell's settings; otherwise they are ``given``.
    """
    arm, declare = given.arm_name, node.parameter
    config = declare("config", "", 'YAML of the cell, whose teleop and external are defaults of these; "": none')
    if config:
        given = _of_cell(given, config)
    preset, mode = preset_of(
        declare("preset", given.preset, "terms of the controller that is driven, by its name"),
        declare("mode", given.mode.value, "raw: the hand's target; filtered: through the built-in controller"),
    )
    prefix = declare("ctrl_prefix", given.ctrl_prefix, "the controller's node, with its namespace").rstrip("/")
    prefix = node.full_name(prefix)
    base = declare("base_frame_id", given.base_frame_id, "frame_id of targets")
    world = declare("world_frame_id", given.world_frame_id, 'whose axes the hand\'s are; "": base_frame_id')
    topic = declare("target_topic", given.target_topic, 'where targets go; "": as the preset says')
    builtin = node.full_name(declare("builtin_node", "cartesian_controller", "the built-in controller's node"))
    controller = node.full_name(declare("controller_node", "", 'whose restart pauses the arm; "": ctrl_prefix'))
    rate = declare("rate", given.rate or preset.rate, "of targets [Hz]", within=(1.0, 1000.0))
    if rate < preset.lowest_rate:
        allowed = f"at least {preset.lowest_rate:g}, better {preset.rate:g}"
        raise ConfigError(f"parameter rate = {rate:g}: preset {preset.name} needs {allowed}")
    return ArmParameters(
        base_frame=base,
        world_frame=world or base,
        tool_frame=declare("end_effector_link_name", given.end_effector_link_name, "frame that the operator moves"),
        controller=controller or (builtin if preset is BUILTIN else prefix),
        prefix=prefix,
        target_topic=topic or preset.topic_of(prefix),
        current_pose_topic=declare("current_pose_topic", "", 'PoseStamped of the tool; "": from /tf'),
        builtin_node=builtin,
        builtin_prefix=declare("builtin_prefix", f"q2r2/{arm}", "where mode filtered sends the hand's target"),
        tool_timeout=declare("tool_timeout", STREAM_TIMEOUT, "of poses of tool and safe target [s]", within=(0.01, 2)),
        listener_timeout=declare("listener_timeout", STREAM_TIMEOUT, "of acknowledgements [s]", within=(0.1, 10)),
        rate=rate,
        preset=preset,
        mode=mode,
        gripper_topic=node.full_name(declare("gripper_action_topic", given.gripper_action_topic, "action or topic")),
        gripper=settings_from_parameters(node, "gripper", given.gripper),
        guard=settings_from_parameters(node, "guard", given.limits.over(preset.guard), read_only=False),
        teleop=_teleop_settings(node, given.teleop),
    )


def teleop_defaults(mirror: bool, filter_window_size: int | None) -> TeleopSettings:
    """Return the settings for the two arguments of an arm's constructor in Quest2ROS2."""
    teleop = TeleopSettings(stance=Stance.MIRROR if mirror else Stance.SIDE_BY_SIDE)
    if filter_window_size is None:
        return teleop
    # A mean over n samples of a 75 Hz headset is delayed by (n - 1) / 2 periods.
    delay = min(max((filter_window_size - 1) / 2 / 75.0, 0.0), 0.2)
    return teleop.model_copy(update={"filter": teleop.filter.model_copy(update={"smoothing_delay": delay})})


def _of_cell(given: ArmDefaults, path: str) -> ArmDefaults:
    cell, side = load_config(path), given.arm_name
    if side not in cell.arms:
        raise ConfigError(f"parameter config: {path} has no arm {side}; allowed: {', '.join(cell.arms)}")
    tool_frame = cell.named_tool_frame(side) or given.end_effector_link_name
    given = replace(given, teleop=cell.teleop, end_effector_link_name=tool_frame)
    if cell.external is None:
        return given
    external, theirs = cell.external, cell.external.arm(side)
    takes_targets = external.terms.takes_targets  # If False, ``rate`` and ``target_topic`` are for joint commands.
    return replace(
        given,
        preset=external.preset,
        mode=external.mode,
        ctrl_prefix=theirs.ctrl_prefix,
        base_frame_id=theirs.base_frame,
        world_frame_id=external.world_frame or "",
        end_effector_link_name=theirs.tool_frame or tool_frame,
        gripper_action_topic=theirs.gripper.topic or given.gripper_action_topic,
        gripper=theirs.gripper.settings(),
        limits=external.limits,
        rate=external.rate if takes_targets else None,
        target_topic=(theirs.target_topic or "") if takes_targets else "",
    )


def _teleop_settings(node: BaseNode, default: TeleopSettings) -> TeleopSettings:
    swapped = default.stance is not Stance.SIDE_BY_SIDE
    mirror = node.parameter(
        "mirror", swapped, "facing the robot: the other hand moves this arm; while both arms hold", read_only=False
    )
    reflected = node.parameter(
        "mirror_reflected",
        mirror and default.stance is Stance.MIRROR_REFLECTED,
        "with mirror: motion to the left becomes motion to the right; while both arms hold",
        read_only=False,
    )
    default = default.model_copy(update={"stance": stance_of(mirror, reflected)})
    settings = settings_from_parameters(
        node, "teleop", default, frozenset({"stance", "workspace", "device"}), read_only=False
    )
    settings.bindings.check_device(QUEST_CONTROLS, "a hand's ROS message")
    return settings


def stance_of(mirror: bool, reflected: bool) -> Stance:
    """Return the stance for ``mirror`` and ``mirror_reflected``; raises :class:`ConfigError`."""
    if reflected and not mirror:
        raise ConfigError("parameter mirror_reflected = True: allowed with mirror = True only")
    return Stance.SIDE_BY_SIDE if not mirror else Stance.MIRROR_REFLECTED if reflected else Stance.MIRROR


def settings_from_parameters(
    node: BaseNode, prefix: str, default: Model, leave_out: frozenset[str] = frozenset(), *, read_only: bool = True
) -> Model:
    """Declare ``prefix.field`` for every field of ``default`` that is not left out; return the resulting settings."""
    values = _values(node, prefix, default, leave_out, read_only)
    return validated(type(default), f"parameter {prefix}.", values)


def _values(
    node: BaseNode, prefix: str, default: BaseModel, leave_out: frozenset[str], read_only: bool
) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for key, info in type(default).model_fields.items():
        value = getattr(default, key)
        if key in leave_out:
            values[key] = value
        elif isinstance(value, BaseModel):
            values[key] = _values(node, f"{prefix}.{key}", value, leave_out, read_only)
        else:
            values[key] = _value(node, f"{prefix}.{key}", value, info, read_only)
    return values


def _value(node: BaseNode, name: str, default: Any, field: FieldInfo, read_only: bool) -> Any:
    description = field.description or name
    if may_be_none(field):
        return node.parameter(name, default or 0.0, f"{description}; here 0", read_only=read_only) or None
    if isinstance(default, Enum):
        return node.parameter(name, str(default.value), description, read_only=read_only)
    if isinstance(default, tuple):
        return tuple(node.parameter(name, list(default), description, read_only=read_only))
    return node.parameter(name, default, description, read_only=read_only, within=range_of(field))


def may_be_none(field: FieldInfo) -> bool:
    """Return whether a setting may be None. The parameter 0 then means None, because no such setting may be 0."""
    return type(None) in getattr(field.annotation, "__args__", ())


def range_of(field: FieldInfo) -> tuple[float, float] | None:
    """Return the closed range of a field, or None. The settings model checks whether the ends are allowed."""
    least = [getattr(entry, name) for entry in field.metadata for name in ("ge", "gt") if hasattr(entry, name)]
    greatest = [getattr(entry, name) for entry in field.metadata for name in ("le", "lt") if hasattr(entry, name)]
    return (float(least[0]), float(greatest[0])) if least and greatest else None
