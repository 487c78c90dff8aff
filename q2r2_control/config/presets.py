"""Terms of community controllers: topic, type, frame, rate, activation, limits.

``{ctrl}`` stands for the controller's own name with its namespace, the parameter ``ctrl_prefix`` of an arm controller.
``{robot}`` stands for that namespace alone. An installed package adds a controller by an entry point of
``q2r2_control.presets`` that is a :class:`Preset` of the same name.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from q2r2_control.config.teleop import GuardSettings
from q2r2_control.errors import ConfigError
from q2r2_control.plugins import PRESETS as ENTRY_POINTS
from q2r2_control.plugins import load_class, names_of

POSE = "geometry_msgs/msg/PoseStamped"


class Hold(StrEnum):
    """Messages to a controller while its arm is paused and its target stands still."""

    REPEAT = "repeat"  # the last target, stamped anew
    SILENCE = "silence"  # nothing: it holds by itself, and a stale target is its own reason to stop


# For controllers without limits of their own.
_CAREFUL = GuardSettings()
# The built-in controller keeps its own limits, which are narrower; what is left is that no target jumps.
_WIDE = GuardSettings(
    max_velocity=3.0, max_acceleration=50.0, max_angular_velocity=12.0, max_angular_acceleration=200.0
)


@dataclass(frozen=True, slots=True)
class Preset:
    """One controller's terms."""

    name: str
    activation: str  # what it takes for a target to count
    topic: str = "{ctrl}/target_frame"  # of its target
    message: str = POSE  # type of its target
    rate: float = 100.0  # that it is driven at [Hz]
    lowest_rate: float = 50.0  # below which it stops or stutters [Hz]
    hold: Hold = Hold.REPEAT
    guard: GuardSettings = _CAREFUL
    output: str = "none"  # of cartesian_controller in mode filtered: what joints it commands itself, if any
    zero_wrench: str | None = None  # topic where a zero wrench is sent, without which it may push
    command_type: str | None = None  # service that has to be told that targets are poses, at each of its starts

    @property
    def takes_poses(self) -> bool:
        """Whether it takes tool poses; other presets take joint positions."""
        return self.message == POSE

    def topic_of(self, ctrl_prefix: str) -> str:
        """Where the controller with this name takes its targets."""
        return self.topic.format(ctrl=ctrl_prefix, robot=ctrl_prefix.rpartition("/")[0])


_LATCHES = "active; keeps the last target for ever"
BUILTIN = Preset("builtin", "always on", rate=100.0, lowest_rate=20.0, hold=Hold.SILENCE, guard=_WIDE)
_ALL = (
    BUILTIN,
    # Its velocity clamp counts the time since the target last changed: a long pause would let the next one through.
    Preset("kuka_lbr_clik", _LATCHES),
    Preset("kuka_lbr_impedance", _LATCHES, rate=200.0, lowest_rate=100.0, zero_wrench="{ctrl}/target_wrench"),
    Preset("fzi", "targets count when they come after its activation"),
    Preset(
        "mayr",
        "active, with filtering.pose: 1.0, since its default is a filter of 9.5 s",
        topic="{ctrl}/reference_pose",
    ),
    Preset(
        "crisp", "active; one publisher, unit quaternions; ctrl_prefix is its namespace", topic="{ctrl}/target_pose"
    ),
    Preset(
        "moveit_servo",
        "{ctrl}/switch_command_type called with 2, which is pose",
        topic="{ctrl}/pose_target_cmds",
        rate=50.0,
        lowest_rate=10.0,
        hold=Hold.SILENCE,
        command_type="{ctrl}/switch_command_type",
    ),
    Preset(
        "lbr_position",
        "the first command equals the measured positions",
        topic="{robot}/command/lbr_joint_position_command",  # resolved in its namespace, so beside the node
        message="lbr_fri_idl/msg/LBRJointPositionCommand",
        rate=200.0,
        lowest_rate=100.0,
        guard=_WIDE,
        output="lbr_position",
    ),
    Preset(
        "lbr_torque",
        "the first command has the measured positions; the Sunrise application asks for TORQUE, every 5 ms or less",
        topic="{robot}/command/lbr_torque_command",
        message="lbr_fri_idl/msg/LBRTorqueCommand",
        rate=500.0,
        lowest_rate=200.0,
        guard=_WIDE,
        output="lbr_torque",
    ),
    Preset(
        "forward_position",
        "the first command equals the measured positions; one value a joint",
        topic="{ctrl}/commands",
        message="std_msgs/msg/Float64MultiArray",
        rate=200.0,
        lowest_rate=100.0,
        guard=_WIDE,
        output="float64",
    ),
    Preset(
        "jtc",
        "active; points with a short horizon",
        topic="{ctrl}/joint_trajectory",
        message="trajectory_msgs/msg/JointTrajectory",
        rate=50.0,
        lowest_rate=20.0,
        hold=Hold.SILENCE,
        guard=_WIDE,
        output="trajectory",
    ),
)
PRESETS = {preset.name: preset for preset in _ALL}


def preset_names() -> tuple[str, ...]:
    """The presets of this package, then those that others have installed."""
    return (*PRESETS, *(name for name in names_of(ENTRY_POINTS) if name not in PRESETS))


def preset_called(name: str) -> Preset:
    """The preset of this package, or of an installed one. Raises :class:`ConfigError`."""
    if name in PRESETS:
        return PRESETS[name]
    if name not in preset_names():
        raise ConfigError(f"preset = {name!r:.60}: allowed are {', '.join(preset_names())}")
    preset = load_class(ENTRY_POINTS, name)
    if not isinstance(preset, Preset) or preset.name != name:
        raise ConfigError(f"{ENTRY_POINTS}: {name} is {preset!r:.60}; allowed: a Preset of that name")
    return preset


class Mode(StrEnum):
    """The kind of target that an external controller follows."""

    RAW = "raw"  # the hand's target itself
    FILTERED = "filtered"  # what the built-in controller makes of it: within limits and free of collisions


# A warning about mode raw, at the start and in q2r2 check.
RAW_WARNING = "raw: no limits, no distances, no self-collision"


def preset_of(name: str, mode: str) -> tuple[Preset, Mode]:
    """Preset and mode by their names. Raises :class:`ConfigError` for names and pairs that are not allowed."""
    preset = preset_called(name)
    if mode not in list(Mode):
        raise ConfigError(f"mode = {mode!r:.60}: allowed are {', '.join(Mode)}")
    if mode == Mode.RAW and not preset.takes_poses:
        takes = "it takes joint positions, which the built-in controller has to make of the hand's target"
        raise ConfigError(f"preset = {name!r} with mode = '{Mode.RAW}': {takes}; allowed is mode {Mode.FILTERED}")
    return preset, Mode(mode)
