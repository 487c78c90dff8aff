"""What community controllers ask of who drives them: topic, type, frame, rate, activation, limits.

``{ctrl}`` stands for the controller's own name with its namespace, the parameter ``ctrl_prefix`` of an arm controller.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from q2r2_control.config.teleop import GuardSettings
from q2r2_control.errors import ConfigError

POSE = "geometry_msgs/msg/PoseStamped"


class FrameChoice(StrEnum):
    """Which ``frame_id`` a controller takes."""

    BASE = "base"  # exactly the base link of its own description, others are ignored or refused
    ANY = "any"  # any, through TF
    IGNORED = "ignored"  # numbers are read in its base link whatever the message says
    NONE = "none"  # its message has none


class Hold(StrEnum):
    """What goes to a controller while its arm is paused and its target stands still."""

    REPEAT = "repeat"  # the last target, stamped anew
    SILENCE = "silence"  # nothing: it holds by itself, and a stale target is its own reason to stop


@dataclass(frozen=True, slots=True)
class Preset:
    """One controller's terms."""

    name: str
    topic: str  # of its target, with {ctrl}
    message: str  # type of its target
    frame: FrameChoice
    rate: float  # that it is driven at [Hz]
    lowest_rate: float  # below which it stops or stutters [Hz]
    hold: Hold
    guard: GuardSettings
    activation: str  # what it takes for a target to count
    output: str = "none"  # of cartesian_controller in mode filtered: what joints it commands itself, if any
    zero_wrench: str | None = None  # topic where a zero wrench is sent, without which it may push
    command_type: str | None = None  # service that has to be told that targets are poses, at each of its starts

    @property
    def takes_poses(self) -> bool:
        """Whether it takes tool poses; other presets take joint positions."""
        return self.message == POSE


# The built-in controller keeps its own limits, which are narrower; what is left is that no target jumps.
_WIDE = GuardSettings(
    max_velocity=3.0, max_acceleration=50.0, max_angular_velocity=12.0, max_angular_acceleration=200.0
)
# For controllers that pass a target on without limits of their own.
_CAREFUL = GuardSettings()

_LATCHES = "active; keeps the last target for ever"
_ALL = (
    Preset("builtin", "{ctrl}/target_frame", POSE, FrameChoice.BASE, 200.0, 20.0, Hold.SILENCE, _WIDE, "always on"),
    Preset(
        name="kuka_lbr_clik",
        topic="{ctrl}/target_frame",
        message=POSE,
        frame=FrameChoice.BASE,
        rate=100.0,
        lowest_rate=50.0,
        # Its velocity clamp counts the time since the target last changed: a long pause lets the next one through.
        hold=Hold.REPEAT,
        guard=_CAREFUL,
        activation=_LATCHES,
    ),
    Preset(
        name="kuka_lbr_impedance",
        topic="{ctrl}/target_frame",
        message=POSE,
        frame=FrameChoice.BASE,
        rate=200.0,
        lowest_rate=100.0,
        hold=Hold.REPEAT,
        guard=_CAREFUL,
        activation=_LATCHES,
        zero_wrench="{ctrl}/target_wrench",
    ),
    Preset(
        name="fzi",
        topic="{ctrl}/target_frame",
        message=POSE,
        frame=FrameChoice.BASE,
        rate=100.0,
        lowest_rate=50.0,
        hold=Hold.REPEAT,
        guard=_CAREFUL,
        activation="targets count when they come after its activation",
    ),
    Preset(
        name="mayr",
        topic="{ctrl}/reference_pose",
        message=POSE,
        frame=FrameChoice.BASE,
        rate=100.0,
        lowest_rate=50.0,
        hold=Hold.REPEAT,
        guard=_CAREFUL,
        activation="active, with filtering.pose: 1.0, since its default is a filter of 9.5 s",
    ),
    Preset(
        name="crisp",
        topic="{ctrl}/target_pose",
        message=POSE,
        frame=FrameChoice.IGNORED,
        rate=100.0,
        lowest_rate=50.0,
        hold=Hold.REPEAT,
        guard=_CAREFUL,
        activation="active; one publisher, unit quaternions; ctrl_prefix is its namespace",
    ),
    Preset(
        name="moveit_servo",
        topic="{ctrl}/pose_target_cmds",
        message=POSE,
        frame=FrameChoice.ANY,
        rate=50.0,
        lowest_rate=10.0,
        hold=Hold.SILENCE,
        guard=_CAREFUL,
        activation="{ctrl}/switch_command_type called with 2, which is pose",
        command_type="{ctrl}/switch_command_type",
    ),
    Preset(
        name="lbr_position",
        topic="{ctrl}/command/joint_position",
        message="lbr_fri_idl/msg/LBRJointPositionCommand",
        frame=FrameChoice.NONE,
        rate=200.0,
        lowest_rate=100.0,
        hold=Hold.REPEAT,
        guard=_WIDE,
        activation="the first command equals the measured positions",
        output="lbr_position",
    ),
    Preset(
        name="forward_position",
        topic="{ctrl}/commands",
        message="std_msgs/msg/Float64MultiArray",
        frame=FrameChoice.NONE,
        rate=200.0,
        lowest_rate=100.0,
        hold=Hold.REPEAT,
        guard=_WIDE,
        activation="the first command equals the measured positions; one value a joint",
        output="float64",
    ),
    Preset(
        name="jtc",
        topic="{ctrl}/joint_trajectory",
        message="trajectory_msgs/msg/JointTrajectory",
        frame=FrameChoice.NONE,
        rate=50.0,
        lowest_rate=20.0,
        hold=Hold.SILENCE,
        guard=_WIDE,
        activation="active; points with a short horizon",
        output="trajectory",
    ),
)
PRESETS = {preset.name: preset for preset in _ALL}
BUILTIN = PRESETS["builtin"]


class Mode(StrEnum):
    """What an external controller follows."""

    RAW = "raw"  # the hand's target itself
    FILTERED = "filtered"  # what the built-in controller makes of it: within limits and free of collisions


def preset_of(name: str, mode: str) -> tuple[Preset, Mode]:
    """Preset and mode by their names. Raises :class:`ConfigError` for names and pairs that are not allowed."""
    if name not in PRESETS:
        raise ConfigError(f"preset = {name!r:.60}: allowed are {', '.join(PRESETS)}")
    if mode not in list(Mode):
        raise ConfigError(f"mode = {mode!r:.60}: allowed are {', '.join(Mode)}")
    preset = PRESETS[name]
    if mode == Mode.RAW and not preset.takes_poses:
        raise ConfigError(
            f"preset = {name!r} with mode = {mode!r}: it takes joint positions, which the built-in controller has to "
            f"make of the hand's target; allowed is mode {Mode.FILTERED.value}"
        )
    return preset, Mode(mode)
