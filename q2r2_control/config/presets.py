"""Properties of community controllers: topic, message type, rate, activation, limits.

``{ctrl}`` stands for the parameter ``ctrl_prefix`` of an arm controller: the controller's own name with its namespace.
``{robot}`` stands for this namespace alone. An installed package can add a controller by an entry point of
``q2r2_control.presets`` that is a :class:`Preset` of the same name.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from q2r2_control.config.teleop import GuardSettings
from q2r2_control.errors import ConfigError
from q2r2_control.plugins import PRESETS as ENTRY_POINTS
from q2r2_control.plugins import load_class, names_of

POSE, TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"


class Hold(StrEnum):
    """The messages to a controller while its arm is paused and its target stands still."""

    REPEAT = "repeat"  # The last target is sent again, with a new stamp.
    SILENCE = "silence"  # Nothing is sent. The controller then holds the arm by itself, and stops if its target is old.


# Limits of targets for controllers that have no limits of their own.
_CAREFUL = GuardSettings()
# The built-in controller keeps its own limits, which are narrower. These limits only prevent jumps of a target.
_WIDE = GuardSettings(
    max_velocity=3.0, max_acceleration=50.0, max_angular_velocity=12.0, max_angular_acceleration=200.0
)


@dataclass(frozen=True, slots=True)
class Preset:
    """The properties of one controller."""

    name: str
    activation: str  # The conditions under which the controller follows a target, in words.
    topic: str = "{ctrl}/target_frame"  # Topic of the controller's target.
    message: str = POSE  # Message type of the controller's target.
    rate: float = 100.0  # Rate at which targets are sent [Hz].
    lowest_rate: float = 50.0  # Below this rate of targets, the arm stops or moves unevenly [Hz].
    hold: Hold = Hold.REPEAT
    guard: GuardSettings = _CAREFUL
    # The kind of joint commands that the node cartesian_controller sends in mode filtered; "none" if it sends none.
    output: str = "none"
    # Topic for a message with a zero wrench, without which the controller can push; None if it needs no such message.
    zero_wrench: str | None = None
    # Service that is called at each start to set the type of targets; None if the controller needs no such call.
    command_type: str | None = None

    @property
    def takes_targets(self) -> bool:
        """Whether the controller takes poses or velocities of the tool. Other presets take joint positions."""
        return self.message in (POSE, TWIST)

    def topic_of(self, ctrl_prefix: str) -> str:
        """Return the topic on which the controller with this name takes its targets."""
        return self.topic.format(ctrl=ctrl_prefix, robot=ctrl_prefix.rpartition("/")[0])


_LATCHES = "active; keeps the last target for ever"
BUILTIN = Preset("builtin", "always on", rate=100.0, lowest_rate=20.0, hold=Hold.SILENCE, guard=_WIDE)
_ALL = (
    BUILTIN,
    # The velocity limit of this controller uses the time since the target last changed. After a long pause without
    # messages, this limit would have no effect on the next target. The preset therefore repeats targets during a pause.
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
    # The next two presets send the target's velocity instead of its pose. The tool can therefore drift away from the
    # target. While the arm is paused, these presets send zero velocity.
    Preset("twist", "it stops the arm by itself when no velocity comes", topic="{ctrl}/teleop_twist", message=TWIST),
    Preset(
        "moveit_servo_twist",
        "{ctrl}/switch_command_type called with 1, which is twist",
        topic="{ctrl}/delta_twist_cmds",
        message=TWIST,
        lowest_rate=20.0,
        command_type="{ctrl}/switch_command_type",
    ),
    Preset(
        "lbr_position",
        "the first command equals the measured positions",
        # The topic begins with {robot}, because the driver resolves its topic in its node's namespace.
        topic="{robot}/command/lbr_joint_position_command",
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
    """Return the names of this package's presets, and then the names of other installed presets."""
    return (*PRESETS, *(name for name in names_of(ENTRY_POINTS) if name not in PRESETS))


def preset_called(name: str) -> Preset:
    """Return the preset of this package, or of an installed one; raises :class:`ConfigError` if there is none."""
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

    RAW = "raw"  # The hand's target itself.
    FILTERED = "filtered"  # The target after the built-in controller: within limits and free of collisions.


# The warning about mode raw. It is shown at the start and by q2r2 check.
RAW_WARNING = "raw: no limits, no distances, no self-collision"


def preset_of(name: str, mode: str) -> tuple[Preset, Mode]:
    """Return preset and mode by their names; raises :class:`ConfigError` if a name or their combination is refused."""
    preset = preset_called(name)
    if mode not in list(Mode):
        raise ConfigError(f"mode = {mode!r:.60}: allowed are {', '.join(Mode)}")
    if mode == Mode.RAW and not preset.takes_targets:
        takes = "it takes joint positions, which the built-in controller has to make of the hand's target"
        raise ConfigError(f"preset = {name!r} with mode = '{Mode.RAW}': {takes}; allowed is mode {Mode.FILTERED}")
    return preset, Mode(mode)
