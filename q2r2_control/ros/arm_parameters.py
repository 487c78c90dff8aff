"""Parameters of an arm controller."""

from __future__ import annotations

from dataclasses import dataclass

from q2r2_control.errors import ConfigError
from q2r2_control.external import GripperSettings
from q2r2_control.ros.node import BaseNode
from q2r2_control.ros.parameters import declared, settings_from_parameters
from q2r2_control.teleop.guard import GuardSettings
from q2r2_control.teleop.presets import BUILTIN, Mode, Preset, preset_of
from q2r2_control.teleop.settings import Stance, TeleopSettings


@dataclass(frozen=True, slots=True)
class ArmDefaults:
    """What a subclass gives."""

    arm_name: str  # left or right
    robot_name: str
    mirror: bool
    base_frame_id: str
    end_effector_link_name: str
    ctrl_prefix: str
    gripper_action_topic: str
    filter_window_size: int | None = None


@dataclass(frozen=True, slots=True)
class ArmParameters:
    """What an arm controller runs with."""

    base_frame: str  # that the controller reads its targets in
    world_frame: str  # whose axes the hand's are
    tool_frame: str
    controller: str  # name of the controller's node
    target_topic: str
    current_pose_topic: str  # "": from /tf
    safe_target_topic: str
    builtin_prefix: str
    tool_timeout: float  # [s]
    link_timeout: float  # [s]
    rate: float  # [Hz]
    preset: Preset
    mode: Mode
    gripper_topic: str
    gripper: GripperSettings
    guard: GuardSettings
    teleop: TeleopSettings


def arm_parameters(node: BaseNode, given: ArmDefaults) -> ArmParameters:
    """Declare all parameters and check them together. Raises :class:`ConfigError` for what is not allowed."""
    arm = given.arm_name
    preset, mode = preset_of(
        declared(node, "preset", BUILTIN.name, "terms of the controller that is driven, by its name"),
        declared(node, "mode", Mode.RAW.value, "raw: the hand's target; filtered: through the built-in controller"),
    )
    prefix = declared(node, "ctrl_prefix", given.ctrl_prefix, "the controller's node, with its namespace").rstrip("/")
    base = declared(node, "base_frame_id", given.base_frame_id, "frame_id of targets")
    rate = declared(node, "rate", preset.rate, "of targets [Hz]", at_least=1.0, at_most=1000.0)
    if rate < preset.lowest_rate:
        raise ConfigError(
            f"parameter rate = {rate:g}: preset {preset.name} needs at least {preset.lowest_rate:g}, "
            f"better {preset.rate:g}"
        )
    topic = declared(node, "target_topic", "", 'where targets go; "": as the preset says')
    controller = declared(node, "controller_node", "", 'whose restart pauses the arm; "": ctrl_prefix')
    return ArmParameters(
        base_frame=base,
        world_frame=declared(node, "world_frame_id", "", 'whose axes the hand\'s are; "": base_frame_id') or base,
        tool_frame=declared(
            node, "end_effector_link_name", given.end_effector_link_name, "frame that the operator moves"
        ),
        controller=controller or ("/cartesian_controller" if preset is BUILTIN else prefix),
        target_topic=topic or preset.topic.format(ctrl=prefix),
        current_pose_topic=declared(node, "current_pose_topic", "", 'PoseStamped of the tool; "": from /tf'),
        safe_target_topic=declared(
            node, "safe_target_topic", f"/cartesian_controller/safe_target/{arm}", "what the built-in controller allows"
        ),
        builtin_prefix=declared(node, "builtin_prefix", f"/q2r2/{arm}", "where mode filtered sends the hand's target"),
        tool_timeout=declared(
            node, "tool_timeout", 0.15, "a tool's pose older than this is not known [s]", at_least=0.01, at_most=2.0
        ),
        link_timeout=declared(
            node, "link_timeout", 0.25, "the other arm's node may be silent [s]", at_least=0.1, at_most=10.0
        ),
        rate=rate,
        preset=preset,
        mode=mode,
        gripper_topic=declared(node, "gripper_action_topic", given.gripper_action_topic, "action or topic"),
        gripper=settings_from_parameters(node, "gripper", GripperSettings(), frozenset()),
        guard=settings_from_parameters(node, "guard", preset.guard, frozenset()),
        teleop=_teleop_settings(node, given),
    )


def _teleop_settings(node: BaseNode, given: ArmDefaults) -> TeleopSettings:
    mirror = declared(node, "mirror", given.mirror, "facing the robot: the other hand moves this arm")
    reflected = declared(node, "mirror_reflected", False, "with mirror: motion to the left becomes motion to the right")
    if reflected and not mirror:
        raise ConfigError("parameter mirror_reflected = True: allowed with mirror = True only")
    stance = Stance.SIDE_BY_SIDE if not mirror else Stance.MIRROR_REFLECTED if reflected else Stance.MIRROR
    default = TeleopSettings(stance=stance)
    if given.filter_window_size is not None:
        # A mean over n samples of a 75 Hz headset comes (n - 1) / 2 periods late.
        delay = min(max((given.filter_window_size - 1) / 2 / 75.0, 0.0), 0.2)
        default = default.model_copy(update={"filter": default.filter.model_copy(update={"smoothing_delay": delay})})
    return settings_from_parameters(node, "teleop", default, frozenset({"stance"}))
