"""The dataclasses that the layers hand to each other: input, teleop, control, plant.

Units are SI units and radians. Quaternions are x y z w. Frames are right-handed with z up (REP-103). Stamps are seconds
of one monotonic clock, which the caller reads. Arms and hands are named ``"left"`` or ``"right"``.
"""

from __future__ import annotations

import math
from base64 import b64decode, b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple, Protocol, TypeGuard

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.device_words import NO_WORDS, QUEST_WORDS, DeviceWords
from q2r2_control.errors import ConfigError, shown
from q2r2_control.events import Reason

POSE_FIELDS = ("x", "y", "z", "qx", "qy", "qz", "qw")
Array = npt.NDArray[np.float64]
"""An array of numpy with 64-bit floats, as all vectors, matrices and joint values here are."""
Flags = npt.NDArray[np.bool_]

SIDES = ("left", "right")
Interval = tuple[float, float]  # The least and the greatest value.
Pose = tuple[tuple[float, float, float], tuple[float, float, float, float]]  # Position [m], quaternion x y z w.
ALL_OF_THE_WAY: Interval = (0.0, 1.0)  # All openings of a gripper, from 0 for closed to 1 for fully open.

LONGEST_DT = 0.1  # The longest tick [s]. After a longer gap nothing moves farther than in this time.
_IDENTITY = pin.SE3.Identity()


def is_number(value: object) -> TypeGuard[float]:
    """Return whether ``value`` is a real number that is finite as a float. True and False are not numbers."""
    if not isinstance(value, float | int | np.floating | np.integer) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # The integer is too large for a float.
        return False


def pose_of(rotation: Array, translation: Array) -> pin.SE3:
    """Return the pose of a rotation (3, 3) and a translation (3,) [m]. It is faster than ``pin.SE3``."""
    pose = _IDENTITY.copy()
    pose.rotation, pose.translation = rotation, translation
    return pose


def moved_by(pose: pin.SE3, way: Array) -> pin.SE3:
    """Return the pose with its origin moved by ``way`` (3,) [m], in the frame in which the pose is given."""
    moved = pose.copy()
    moved.translation = moved.translation + way
    return moved


@dataclass(frozen=True, slots=True)
class HandInputs:
    """Buttons, triggers and stick of one hand controller.

    ``button_lower`` is A on the right and X on the left controller, ``button_upper`` is B and Y. Triggers go from 0 to
    1, and sticks from -1 to 1. ``more`` has further controls of other devices by name, from 0 at rest to 1 for pressed.
    A missing control is at rest.
    """

    button_upper: bool = False
    button_lower: bool = False
    thumb_stick_horizontal: float = 0.0
    thumb_stick_vertical: float = 0.0
    press_index: float = 0.0
    press_middle: float = 0.0
    more: Mapping[str, float] = field(default_factory=dict, hash=False)


@dataclass(frozen=True, slots=True)
class DeviceControls:
    """The buttons and axes that an input device has for each hand: fields of :class:`HandInputs`, and other names."""

    buttons: tuple[str, ...]
    axes: tuple[str, ...]
    words: DeviceWords = NO_WORDS

    @property
    def names(self) -> tuple[str, ...]:
        return self.buttons + self.axes


QUEST_CONTROLS = DeviceControls(
    buttons=("button_upper", "button_lower"),
    axes=("thumb_stick_horizontal", "thumb_stick_vertical", "press_index", "press_middle"),
    words=QUEST_WORDS,
)
"""The controls of each hand of a Quest: two buttons, both axes of a stick (-1 .. 1), and two triggers (0 .. 1)."""


class HandFault(StrEnum):
    """Faults of a hand whose pose alone looks valid. The values are kinds of :mod:`events`."""

    FROZEN = "hand_frozen"
    FRAME_MOVED = "hand_frame_moved"  # Both hands moved together, so their frame has probably moved.
    UNTRACKED = "hand_untracked"  # The headset reports no pose, or reports that its pose is a guess.


@dataclass(frozen=True, slots=True)
class HandSample:
    """One reading of one hand, as it was received. Nothing has been checked or normalised yet.

    The pose and the controls arrive in separate messages. Pose and controls have separate times of receipt, so that the
    stop of one stream is noticed.
    """

    hand: str
    position: Array  # (3,) Position in the input's own frame [m].
    quaternion: Array  # (4,) Rotation x y z w, of any length.
    pose_stamp: float  # Time of receipt of the pose [s].
    inputs: HandInputs = field(default_factory=HandInputs)
    inputs_stamp: float = float("-inf")  # Time of receipt of the controls [s]; -inf if none were received yet.
    fault: HandFault | None = None  # Why no arm may follow this pose or be engaged at it; None if it may.


@dataclass(frozen=True, slots=True)
class HapticFeedback:
    """Vibration of one hand controller, with frequency and amplitude from 0 to 1."""

    hand: str
    frequency: float
    amplitude: float


@dataclass(slots=True)
class RobotState:
    """The measured state of a plant, in the joint order of ``Robot.model``."""

    q: Array  # (nv,) Joint positions [rad].
    v: Array  # (nv,) Joint velocities [rad/s].
    tau: Array  # (nv,) Measured joint torques [Nm].
    tau_external: Array | None  # (nv,) Torque from contacts [Nm]; None if the plant does not measure it.
    stamp: float  # Time of the measurement or of its receipt [s].
    held: Array | None = None  # (nv,) Posture at which the drives hold the arms [rad]; None if it is not reported.


class CommandMode(StrEnum):
    """The quantity of a command that a plant follows."""

    POSITION = "position"
    VELOCITY = "velocity"
    TORQUE = "torque"

    @classmethod
    def _missing_(cls, value: object) -> CommandMode:
        raise ConfigError(f"mode = {shown(value)}: allowed: {', '.join(cls)}")


@dataclass(slots=True)
class Command:
    """A command for the plant, in the joint order of ``Robot.model``."""

    mode: CommandMode
    # (nv,) Joint positions [rad]. In velocity and torque mode, they are the reference, which a plant may show.
    q: Array
    v: Array  # (nv,) Joint velocities [rad/s].
    tau: Array  # (nv,) The commanded joint torques in torque mode [Nm].
    grippers: dict[str, float]  # Openings by arm, from 0 for closed to 1 for fully open.
    # (nv,) Deceleration of the certified stop from q and v [rad/s^2]; None if no stop is known.
    deceleration: Array | None = None
    # True if tau only compensates gravity, for a posture that may be wrong. A plant with its own sensors then brakes
    # the arms.
    gravity_only: bool = False


class ObservedPicture(Protocol):
    """A picture of a camera, simulated or real."""

    @property
    def time(self) -> float:
        """The time at which the picture was captured, by the loop's clock [s]."""

    @property
    def pixels(self) -> npt.NDArray[np.uint8]:
        """The picture (height, width, 3), r g b. It is decoded or rendered when it is read for the first time."""


@dataclass(frozen=True, slots=True)
class Observation:
    """The data of one tick for a policy: the state before the command, with the time of the loop's clock."""

    time: float  # Time of the loop's clock [s].
    state: RobotState  # Measured before the command of the tick.
    openings: Mapping[str, float]  # Measured openings by arm, 0 closed .. 1 open, of arms that measure them.
    tools: Mapping[str, pin.SE3]  # Measured poses of the tools, in the world frame.
    # The newest picture of each camera of the cell. If a camera gives no picture, reading it raises CameraError.
    pictures: Mapping[str, ObservedPicture] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class ActionChunk:
    """Checked actions of a policy at n times, as poses or motions of the tools; or a fault, if they are not usable."""

    times: Array  # (n,) Ascending times of the loop's clock [s].
    period: float  # Time from one action to the next [s]. It is also given for a single action.
    tools: Mapping[str, Array] = field(default_factory=dict)  # (n, 7) for each arm: x y z qx qy qz qw in the world.
    # (n, 6) for each arm: translation [m] and rotation vector [rad], in the frame of the previous target.
    motions: Mapping[str, Array] = field(default_factory=dict)
    grippers: Mapping[str, Array] = field(default_factory=dict)  # (n,) for each arm: openings, 0 closed .. 1 open.
    postures: Array | None = None  # (n, nv) Joint positions that are wanted as far as the tools leave them free [rad].
    fault: Reason | None = None  # Why the actions are not usable; None if they are.

    def as_json(self) -> dict[str, Any]:
        """Return data for ``json.dumps``, from which :meth:`from_json` makes the same chunk, bit for bit."""
        named = {"tools": self.tools, "motions": self.motions, "grippers": self.grippers}
        data: dict[str, Any] = {
            name: {arm: _packed(values) for arm, values in arms.items()} for name, arms in named.items()
        }
        data |= {"times": _packed(self.times), "period": self.period}
        data["postures"] = None if self.postures is None else _packed(self.postures)
        return data | {"fault": None if self.fault is None else self.fault.as_json()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> ActionChunk:
        """Make the chunk from the data of :meth:`as_json`.

        Raises:
            ValueError, KeyError, TypeError: For other data.
        """
        times = _unpacked(data["times"])
        shapes = {"tools": (len(times), 7), "motions": (len(times), 6), "grippers": (len(times),)}
        named = {
            name: {arm: _unpacked(values).reshape(shape) for arm, values in data[name].items()}
            for name, shape in shapes.items()
        }
        postures = None if data["postures"] is None else _unpacked(data["postures"]).reshape(len(times), -1)
        fault = None if data["fault"] is None else Reason.from_json(data["fault"])
        return cls(times, float(data["period"]), **named, postures=postures, fault=fault)


def _packed(values: Array) -> str:
    """Return the float64 values of an array as base64. To write decimal numbers would take a millisecond."""
    return b64encode(values.tobytes()).decode("ascii")


def _unpacked(text: str) -> Array:
    return np.frombuffer(b64decode(text), dtype=np.float64)


class StepStatus(StrEnum):
    """The outcome of one control tick."""

    OK = "ok"
    TARGET_REJECTED = "target_rejected"  # A target was not usable, and its arm keeps the last target.
    DT_REJECTED = "dt_rejected"  # dt was not in (0, 0.1] s.
    RECOVERING = "recovering"  # A joint is outside a limit, or a pair is too close. The arms move back.
    FALLBACK = "fallback"  # The certified stop was executed instead of the solution of the QP, at least in part.


class LimitKind(StrEnum):
    """The kinds of limits that hold a step back."""

    POSITION = "position"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"
    SEPARATION = "separation"
    TOOL_SPEED = "tool_speed"
    CONSTRAINT = "constraint"  # One of the user's own constraints.


class ActiveLimit(NamedTuple):
    """A limit that was active in the solution of a step."""

    kind: LimitKind
    names: tuple[str, ...]  # The joint, both geometries of a pair, the arm of a tool, or the class of a constraint.


@dataclass(slots=True)
class StepReport:
    """The outcome of one control tick. Distances are in metres, and joints are given by name."""

    status: StepStatus
    rejected: tuple[str, ...]  # Arms whose target was not usable, and which keep the last target.
    binding: tuple[ActiveLimit, ...]  # The limits that were active in the solution.
    closest_pair: tuple[str, str]  # Names of the two closest geometries.
    closest_distance: float  # Distance of the closest pair [m].
    certified: bool  # Whether a stop is known that keeps all limits and distances.
    fallback: bool  # Whether the certified stop was executed, at least in part.
    slack: float  # Largest violation of a row of the QP [rad/s]. All rows have unit norm.
    solve_time: float  # Time of the solver [s]; 0 if the solver was not needed.
    tightest_pair: tuple[str, str] = ("", "")  # Names of the geometries of the pair with the least margin.
    margin: float = math.inf  # Distance of the tightest pair minus the distance that it has to keep [m].
    unsolved: int = 0  # Bit i is set if the QP of substep i had no solution in time, so that the stop was executed.
    faults: tuple[str, ...] = ()  # Why targets, or answers of the user's tasks, constraints and solver, were not used.


@dataclass(slots=True)
class Reference:
    """The certified joint motion of one tick.

    ``a`` is the mean acceleration from the previous tick's velocity to ``v``. Its integral is not exactly ``q``,
    because the acceleration may change between substeps.
    """

    q: Array  # (nv,) Joint positions [rad].
    v: Array  # (nv,) Joint velocities [rad/s].
    a: Array  # (nv,) Mean joint accelerations since the previous tick [rad/s^2].
    report: StepReport


@dataclass(slots=True)
class ArmTarget:
    """The target of one arm from the teleop layer."""

    pose: pin.SE3 | None  # Target of the tool in the world frame; None if the arm has to hold its reference.
    gripper: float  # Opening, from 0 for closed to 1 for fully open.
    slip: float = 0.0  # Distance by which leash and workspace have held the target back since engaging [m].
    slip_angle: float = 0.0  # Angle by which leash and workspace have held the target back since engaging [rad].
    offset: Array | None = None  # (3,) Measured minus commanded tool position when engaged [m]; None if not known.
    filtered_hand: Pose | None = None  # The filtered pose of the hand from which the target was computed.
    posture: Array | None = None  # (nv,) Posture that a policy wants, as far as the tool leaves it free [rad].

    @property
    def hand(self) -> pin.SE3 | None:
        """Return ``filtered_hand`` as a pose, in the input's frame; None if there is none."""
        if self.filtered_hand is None:
            return None
        position, quaternion = self.filtered_hand
        return pin.XYZQUATToSE3(position + quaternion)

    @property
    def command(self) -> pin.SE3 | None:
        """Return the controller's target for which the measured tool reaches ``pose``; None if ``pose`` is None."""
        return None if self.pose is None else self.command_for(self.pose)

    def command_for(self, tool: pin.SE3) -> pin.SE3:
        """Return the controller's target for which the measured tool reaches ``tool`` (both in the world frame)."""
        return tool if self.offset is None else moved_by(tool, -self.offset)


@dataclass(frozen=True, slots=True)
class ArmTiming:
    """The timing of one arm relative to the reference that it follows. All times are in seconds."""

    behind: float | None  # Lag that the arm's newest message reports; None if the lag is measured instead.
    silent: float  # Time since the arm's newest message.
    period: float  # Usual time between two messages.
    noise: float = 0.0  # Noise of ``behind``.

    @property
    def lag(self) -> float:
        """The greatest possible lag of the arm now. It grows with ``silent``, because a silent arm may stand still."""
        return (self.behind or 0.0) + max(self.silent - self.period, 0.0)
