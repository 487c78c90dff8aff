"""The dataclasses that cross a border between layers: input, teleop, control, plant.

SI units, radians, quaternions x y z w, right-handed frames with z up (REP-103). Stamps are seconds on one monotonic
clock that is passed in. An arm or hand is named ``"left"`` or ``"right"``.
"""

from __future__ import annotations

import math
from base64 import b64decode, b64encode
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, NamedTuple, TypeGuard

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.device_words import NO_WORDS, QUEST_WORDS, DeviceWords
from q2r2_control.errors import ConfigError, shown
from q2r2_control.events import Reason

POSE_FIELDS = ("x", "y", "z", "qx", "qy", "qz", "qw")
Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

SIDES = ("left", "right")
Interval = tuple[float, float]  # least and greatest
Pose = tuple[tuple[float, float, float], tuple[float, float, float, float]]  # position [m], quaternion x y z w
ALL_OF_THE_WAY: Interval = (0.0, 1.0)  # of a gripper's opening, 0 closed .. 1 fully open

LONGEST_DT = 0.1  # [s] of a tick; after a longer gap nothing moves further than in this time
_IDENTITY = pin.SE3.Identity()


def is_number(value: object) -> TypeGuard[float]:
    """Whether ``value`` is a real number that is finite as a float; a truth value is none."""
    if not isinstance(value, float | int | np.floating | np.integer) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer that no float can hold
        return False


def pose_of(rotation: Array, translation: Array) -> pin.SE3:
    """The pose of a rotation (3, 3) and a translation (3,) [m], faster than ``pin.SE3``."""
    pose = _IDENTITY.copy()
    pose.rotation, pose.translation = rotation, translation
    return pose


def moved_by(pose: pin.SE3, way: Array) -> pin.SE3:
    """The pose with its origin elsewhere, by ``way`` (3,) [m] in the frame that the pose is told in."""
    moved = pose.copy()
    moved.translation = moved.translation + way
    return moved


@dataclass(frozen=True, slots=True)
class HandInputs:
    """Buttons, triggers and stick of one hand controller, as the headset names them, and those of other devices.

    ``button_lower`` is A (right) or X (left), ``button_upper`` B or Y; triggers 0..1, sticks -1..1. ``more`` has what
    a device declares beyond these, by name: 0 at rest, 1 pressed. A name that is left out is at rest.
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
    """Buttons and axes of each hand of an input device: fields of :class:`HandInputs`, and names of its own."""

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


class HandFault(StrEnum):
    """Faults of a hand whose pose by itself is valid: kinds of :mod:`events`."""

    FROZEN = "hand_frozen"
    FRAME_MOVED = "hand_frame_moved"  # both hands moved as one, as when the frame moves that they are measured in
    UNTRACKED = "hand_untracked"  # the headset says that its pose is none, or a guess


@dataclass(frozen=True, slots=True)
class HandSample:
    """One reading of one hand. Numbers are as received: nothing has been checked or normalised yet.

    Pose and inputs travel in separate messages. Each has its own receipt time, so that a stream that stops is noticed.
    """

    hand: str
    position: Array  # (3,) [m], in the input's own frame
    quaternion: Array  # (4,) x y z w, not necessarily normalised
    pose_stamp: float  # receipt time of the pose [s]
    inputs: HandInputs = field(default_factory=HandInputs)
    inputs_stamp: float = float("-inf")  # receipt time of the inputs [s]; -inf: none received yet
    fault: HandFault | None = None  # why no arm may follow this pose, nor be engaged at it


@dataclass(frozen=True, slots=True)
class HapticFeedback:
    """Vibration of one hand controller: frequency and amplitude, both 0..1."""

    hand: str
    frequency: float
    amplitude: float


@dataclass(slots=True)
class RobotState:
    """Measurements of the plant, in the joint order of ``Robot.model``."""

    q: Array  # (nv,) [rad]
    v: Array  # (nv,) [rad/s]
    tau: Array  # (nv,) measured joint torque [Nm]
    tau_external: Array | None  # (nv,) torque from contacts [Nm]; None where the plant cannot tell
    stamp: float  # [s]
    held: Array | None = None  # (nv,) where the plant's own drives hold the arms, if it tells [rad]


class CommandMode(StrEnum):
    """How a plant follows a command."""

    POSITION = "position"
    VELOCITY = "velocity"
    TORQUE = "torque"

    @classmethod
    def _missing_(cls, value: object) -> CommandMode:
        raise ConfigError(f"mode = {shown(value)}: allowed: {', '.join(cls)}")


@dataclass(slots=True)
class Command:
    """A command to the plant, in the joint order of ``Robot.model``."""

    mode: CommandMode
    q: Array  # (nv,) [rad]; in velocity and torque mode the reference, for plants that show it
    v: Array  # (nv,) [rad/s]
    tau: Array  # (nv,) [Nm]; of torque mode
    grippers: dict[str, float]  # arm -> opening, 0 closed .. 1 fully open
    deceleration: Array | None = None  # (nv,) of the certified stop from q and v [rad/s^2]; None: none is known
    gravity_only: bool = False  # tau bears the arms at an unsure posture: a plant that measures by itself brakes them


@dataclass(frozen=True, slots=True)
class Observation:
    """The view that a policy has of one tick: the state before its command, on the loop's clock."""

    time: float  # [s]
    state: RobotState
    openings: Mapping[str, float]  # measured, of the arms whose plant tells: 0 closed .. 1 fully open
    tools: Mapping[str, pin.SE3]  # measured tool poses, world frame


@dataclass(frozen=True, slots=True)
class ActionChunk:
    """Actions of a policy at n times, checked and told as tool poses; or the fault that makes all of them unusable."""

    times: Array  # (n,) [s] on the loop's clock, ascending
    period: float  # from one action to the next, also where there is one only [s]
    tools: Mapping[str, Array] = field(default_factory=dict)  # arm -> (n, 7) x y z qx qy qz qw, world frame
    motions: Mapping[str, Array] = field(default_factory=dict)  # arm -> (n, 6) to the next target, in its frame
    grippers: Mapping[str, Array] = field(default_factory=dict)  # arm -> (n,) openings
    postures: Array | None = None  # (n, nv) of all joints, for what the tools leave free [rad]
    fault: Reason | None = None

    def as_json(self) -> dict[str, Any]:
        """Data for ``json.dumps``, of which :meth:`from_json` makes the same chunk to the bit; made within a tick."""
        named = {"tools": self.tools, "motions": self.motions, "grippers": self.grippers}
        data: dict[str, Any] = {
            name: {arm: _packed(values) for arm, values in arms.items()} for name, arms in named.items()
        }
        data |= {"times": _packed(self.times), "period": self.period}
        data["postures"] = None if self.postures is None else _packed(self.postures)
        return data | {"fault": None if self.fault is None else self.fault.as_json()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> ActionChunk:
        """Raises ValueError, KeyError or TypeError for other data."""
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
    """The float64 of an array as base64; decimals of a long chunk would take a millisecond."""
    return b64encode(values.tobytes()).decode("ascii")


def _unpacked(text: str) -> Array:
    return np.frombuffer(b64decode(text), dtype=np.float64)


class StepStatus(StrEnum):
    """The outcome of one control tick."""

    OK = "ok"
    TARGET_REJECTED = "target_rejected"  # a bad target was held
    DT_REJECTED = "dt_rejected"  # dt was not in (0, 0.1] s
    RECOVERING = "recovering"  # outside a limit or closer than a pair may be, on the way back
    FALLBACK = "fallback"  # the stopping motion was executed instead of the QP's solution


class LimitKind(StrEnum):
    """Kinds of limits that hold a step back."""

    POSITION = "position"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"
    SEPARATION = "separation"
    TOOL_SPEED = "tool_speed"
    CONSTRAINT = "constraint"  # of a program's own


class ActiveLimit(NamedTuple):
    """A limit that was active at a step's solution."""

    kind: LimitKind
    names: tuple[str, ...]  # of the joint, both geometries of a pair, the tool's arm, or a constraint's class


@dataclass(slots=True)
class StepReport:
    """Outcome and reasons of one control tick. Distances in metres, joints by name."""

    status: StepStatus
    rejected: tuple[str, ...]  # arms whose target was not usable and is held
    binding: tuple[ActiveLimit, ...]  # limits active at the solution
    closest_pair: tuple[str, str]  # geometry names
    closest_distance: float  # [m]
    certified: bool  # a stopping motion that keeps limits and separation is known
    fallback: bool
    slack: float  # largest violation of a row of unit norm [rad/s]
    solve_time: float  # solver's own time, 0 where none had to be asked [s]
    tightest_pair: tuple[str, str] = ("", "")  # geometry names of the pair with the least margin
    margin: float = math.inf  # its distance less the one that it keeps [m]
    unsolved: int = 0  # bit i: the QP of substep i had no solution, or too late, and the stop went on
    faults: tuple[str, ...] = ()  # a program's own tasks and constraints whose answer was not used, and why


@dataclass(slots=True)
class Reference:
    """Joint motion that the QP allows, once per tick.

    ``a`` leads from the last tick's velocity to ``v``, but ``q`` is not in general where it alone would lead, since
    acceleration changes between substeps.
    """

    q: Array  # (nv,) [rad]
    v: Array  # (nv,) [rad/s]
    a: Array  # (nv,) mean since the last tick [rad/s^2]
    report: StepReport


@dataclass(slots=True)
class ArmTarget:
    """The teleop layer's target for one arm."""

    pose: pin.SE3 | None  # tool pose in the world frame; None: hold
    gripper: float  # opening, 0 closed .. 1 fully open
    slip: float = 0.0  # how far the target has slipped along with a tool held up, since engaging [m]
    slip_angle: float = 0.0  # the same of the rotation [rad]
    offset: Array | None = None  # (3,) of the tool, from its command [m]; None: none
    filtered_hand: Pose | None = None  # the pose of its hand, filtered, that the target is made of
    posture: Array | None = None  # (nv,) that a policy wants this arm's joints to have where the tool leaves them free

    @property
    def hand(self) -> pin.SE3 | None:
        """``filtered_hand`` as a pose."""
        if self.filtered_hand is None:
            return None
        position, quaternion = self.filtered_hand
        return pin.XYZQUATToSE3(position + quaternion)

    @property
    def command(self) -> pin.SE3 | None:
        """The controller's target that brings the tool to ``pose``."""
        return None if self.pose is None else self.command_for(self.pose)

    def command_for(self, tool: pin.SE3) -> pin.SE3:
        """The controller's target that brings the tool to ``tool``, world frame."""
        return tool if self.offset is None else moved_by(tool, -self.offset)


@dataclass(frozen=True, slots=True)
class ArmTiming:
    """Timing of an arm against the reference that it follows, all in [s]."""

    behind: float | None  # the reference, by the newest message of the arm; None: nobody tells, so that it is measured
    silent: float  # time since that message
    period: float  # between its messages, as a rule
    noise: float = 0.0  # of ``behind``

    @property
    def lag(self) -> float:
        """How far behind the arm may be by now: a message that is missing may say that the arm stands still."""
        return (self.behind or 0.0) + max(self.silent - self.period, 0.0)
