"""What happens to the arms, as data: a kind and its payload. Code decides by these; :mod:`wording` makes sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any


class ReasonKind(StrEnum):
    """Why an arm changed its state, or did not; what became of a request; what is wrong. Values are stable."""

    # An operator's controls.
    PRESSED = "pressed"
    COMMANDED = "commanded"  # an action that is for both arms
    DEAD_MAN_HELD = "dead_man_held"
    DEAD_MAN_RELEASED = "dead_man_released"
    ALIGNMENT_CHORD = "alignment_chord"
    ALIGNED = "aligned"
    CARRY_BEGAN = "carry_began"  # this arm's hand moves both tools
    CARRIED_BY = "carried_by"
    CARRY_ENDED = "carry_ended"
    RESET_SERVICE = "reset_service"
    PAUSE_SERVICE = "pause_service"

    # The way home.
    HOMING = "homing"
    HOMING_ARRIVED = "homing_arrived"
    HOMING_HELD_UP = "homing_held_up"
    HOMING_NO_WAY = "homing_no_way"
    HOMING_INTERRUPTED = "homing_interrupted"
    HOMING_ENDED = "homing_ended"
    HOMING_FAULT = "homing_fault"

    # The recording.
    EPISODE_BEGINS = "episode_begins"
    EPISODE_ENDS = "episode_ends"
    EPISODE_SUCCEEDED = "episode_succeeded"
    EPISODE_FAILED = "episode_failed"
    EPISODE_DISCARDED = "episode_discarded"
    MARK = "mark"
    VERDICT = "verdict"

    # Requests of a program.
    HOME_REQUESTED = "home_requested"
    SETTINGS_REQUESTED = "settings_requested"
    CONTROL_REQUESTED = "control_requested"
    SETTINGS_CHANGED = "settings_changed"
    CONTROL_CHANGED = "control_changed"

    # Refusals: nothing changed. Those of the first group have a cause.
    NOT_ENGAGED = "not_engaged"
    NOT_HOMING = "not_homing"
    NOT_CARRIED = "not_carried"
    NOT_CHANGED = "not_changed"
    NO_RECORDING = "no_recording"
    RECORDING_ENDED = "recording_ended"
    NO_EPISODE = "no_episode"

    # Faults of a hand and its data.
    POSE_SILENT = "pose_silent"
    POSE_GAP = "pose_gap"
    INPUTS_SILENT = "inputs_silent"
    POSE_WITHOUT_STAMP = "pose_without_stamp"
    POSE_UNUSABLE = "pose_unusable"
    NO_POSE = "no_pose"
    HAND_FROZEN = "hand_frozen"
    HAND_FRAME_MOVED = "hand_frame_moved"
    HAND_JUMPED = "hand_jumped"
    HAND_ROTATION_JUMPED = "hand_rotation_jumped"
    HAND_TOO_FAST = "hand_too_fast"
    HAND_TURNS_TOO_FAST = "hand_turns_too_fast"
    CONNECTION_LOST = "connection_lost"
    LOOP_STALLED = "loop_stalled"
    NODE_STALLED = "node_stalled"
    CLOCK_NOT_FINITE = "clock_not_finite"
    CLOCK_WENT_BACK = "clock_went_back"
    LINKED = "linked"  # the other arm has a fault, which is the cause

    # Obstacles to a request.
    TOOL_UNKNOWN = "tool_unknown"
    CONTROLS_HELD = "controls_held"
    STOPPED = "stopped"
    ALIGNING = "aligning"
    CARRYING = "carrying"
    ENGAGE_FIRST = "engage_first"
    ONE_ARM = "one_arm"
    OTHER_ARM_BUSY = "other_arm_busy"
    TOOL_HELD_UP = "tool_held_up"
    ARMS_MUST_HOLD = "arms_must_hold"
    CONTROL_REFUSED = "control_refused"

    # Obstacles that ROS nodes find; their text is in the detail.
    NO_SUBSCRIBER = "no_subscriber"  # of an arm's targets
    NO_TOOL_POSE = "no_tool_pose"
    NO_TRANSFORM = "no_transform"
    HAND_SILENT = "hand_silent"
    SEVERAL_PUBLISHERS = "several_publishers"
    CONTROLLER_REFUSES = "controller_refuses"
    BAD_JOINT_STATES = "bad_joint_states"

    # What supervision finds.
    NO_STATES_YET = "no_states_yet"
    STATES_SILENT = "states_silent"
    STATE_NOT_FINITE = "state_not_finite"
    STATE_JUMPED = "state_jumped"
    JOINT_STATES = "joint_states"  # are not good, for the cause
    OFF_REFERENCE = "off_reference"
    TOO_CLOSE = "too_close"
    LEFT_BEHIND = "left_behind"
    RUN_ENDED = "run_ended"
    STOP_SERVICE = "stop_service"
    ACTIVATED = "activated"
    HOMING_OUTCOME = "homing_outcome"
    CONTROLLER_PHASE = "controller_phase"  # in which it follows no targets
    CONTROLLER_PAUSED = "controller_paused"
    ARMS_HOMING = "arms_homing"
    ARMS_BRAKING = "arms_braking"
    STREAM_AWAY = "stream_away"  # from the tool, where it begins or goes on
    PUBLISHER_CHANGED = "publisher_changed"
    TWO_PUBLISHERS = "two_publishers"
    TARGETS_CEASED = "targets_ceased"
    TARGETS_LINKED = "targets_linked"  # hold because those of the other arm do, for the cause
    TARGET_LATE = "target_late"
    TARGET_FRAME = "target_frame"
    TARGET_NOT_A_POSE = "target_not_a_pose"

    OTHER = "other"  # a sentence made elsewhere, which nothing decides by


REFUSALS = frozenset(
    {
        *(ReasonKind.NOT_ENGAGED, ReasonKind.NOT_HOMING, ReasonKind.NOT_CARRIED),
        *(ReasonKind.NOT_CHANGED, ReasonKind.NO_RECORDING, ReasonKind.RECORDING_ENDED, ReasonKind.NO_EPISODE),
    }
)


@dataclass(frozen=True, slots=True)
class Reason:
    """A kind and what belongs to it; ``detail`` holds numbers, texts, names and lists of these, in SI units."""

    kind: ReasonKind
    detail: Mapping[str, Any] = field(default_factory=dict)
    cause: Reason | None = None  # what it follows from

    @classmethod
    def of(cls, kind: ReasonKind, cause: Reason | None = None, **detail: Any) -> Reason:
        """The reason of this ``kind`` with its ``detail`` by name."""
        return cls(kind, detail, cause)

    @classmethod
    def in_words(cls, text: str) -> Reason:
        """A sentence that nothing decides by."""
        return cls(ReasonKind.OTHER, {"text": text})

    @property
    def root(self) -> Reason:
        """The first cause."""
        return self if self.cause is None else self.cause.root

    def as_json(self) -> dict[str, Any]:
        """Data for ``json.dumps``; what is empty is left out."""
        data: dict[str, Any] = {"kind": str(self.kind)}
        if self.detail:
            data["detail"] = dict(self.detail)
        if self.cause is not None:
            data["cause"] = self.cause.as_json()
        return data

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Reason:
        """The reason that :meth:`as_json` made data of. Raises ValueError, KeyError or TypeError for other data."""
        cause = cls.from_json(data["cause"]) if "cause" in data else None
        return cls(ReasonKind(data["kind"]), dict(data.get("detail", {})), cause)


@dataclass(frozen=True, slots=True)
class Event:
    """A change of an arm's teleop state, or, where both states are the same, what its operator should know."""

    t: float  # [s]
    arm: str
    source: str  # state before
    destination: str  # state after
    reason: Reason

    @property
    def kind(self) -> ReasonKind:
        """The kind of its reason."""
        return self.reason.kind

    def as_json(self) -> dict[str, Any]:
        """Data for ``json.dumps``: ``t``, ``arm``, ``from``, ``to``, ``kind``, and ``detail`` and ``cause`` if any."""
        states = {"from": str(self.source), "to": str(self.destination)}
        return {"t": self.t, "arm": self.arm, **states, **self.reason.as_json()}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Event:
        """The event that :meth:`as_json` made data of. Raises ValueError, KeyError or TypeError for other data."""
        return cls(float(data["t"]), data["arm"], data["from"], data["to"], Reason.from_json(data))
