"""Actions of a hand's controls. Each gesture has one action or none."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from typing import NamedTuple

from pydantic import Field, model_validator

from q2r2_control.config.strict import StrictModel
from q2r2_control.errors import ConfigError
from q2r2_control.types import QUEST_CONTROLS, DeviceControls


class Action(StrEnum):
    """Actions of a hand's controls. Their meanings are in ``MEANINGS``."""

    NONE = "none"
    # These actions are done once, when a control was tapped or held for a while.
    PAUSE_TOGGLE = "pause_toggle"
    GRIPPER_TOGGLE = "gripper_toggle"
    HOME = "home"
    STOP = "stop"
    CARRY = "carry"
    RECORD_TOGGLE = "record_toggle"
    RECORD_DISCARD = "record_discard"
    RECORD_SUCCESS = "record_success"
    RECORD_FAILURE = "record_failure"
    RECORD_MARK = "record_mark"
    NEXT_SUBTASK = "next_subtask"
    # These actions last for as long as a trigger or stick is held.
    DEAD_MAN = "dead_man"
    PRECISION = "precision"
    ROTATION_LOCK = "rotation_lock"
    TRANSLATION_LOCK = "translation_lock"
    GRIPPER_ANALOG = "gripper_analog"


LASTING = frozenset(
    {Action.DEAD_MAN, Action.PRECISION, Action.ROTATION_LOCK, Action.TRANSLATION_LOCK, Action.GRIPPER_ANALOG}
)


class Gesture(StrEnum):
    """How a control is used.

    ``DOWN`` is the start of a press, and has no action. However, if the control pauses an arm, the arm already stops at
    ``DOWN``.
    """

    DOWN = "down"
    TAP = "tap"
    HOLD = "hold"


# The meaning of each action, in words for the operator.
MEANINGS: dict[str, str] = {
    Action.PAUSE_TOGGLE: "engages the arm where it is, or pauses it",
    Action.GRIPPER_TOGGLE: "closes the gripper, or opens it, where the arm has one",
    Action.HOME: "brings both arms home; any press on the way stops them",
    Action.STOP: "stops both arms until it is done once more",
    Action.CARRY: "lets this hand move both tools as one body, or ends that",
    Action.RECORD_TOGGLE: "begins an episode of the recording, or ends it",
    Action.RECORD_DISCARD: "throws away the episode, or the last one if it has ended",
    Action.RECORD_SUCCESS: "says that the episode, or the last one, succeeded, and ends it",
    Action.RECORD_FAILURE: "says that the episode, or the last one, failed, and ends it",
    Action.RECORD_MARK: "marks this moment in the recording",
    Action.NEXT_SUBTASK: "begins the next subtask of the episode",
    Action.DEAD_MAN: "held: the arm follows; let go: it pauses",
    Action.PRECISION: "held: motion is scaled by precision_scale",
    Action.ROTATION_LOCK: "held: the tool keeps its orientation",
    Action.TRANSLATION_LOCK: "held: the tool keeps its position",
    Action.GRIPPER_ANALOG: "closes the gripper, where the arm has one, as far as it is pressed",
}
# Fields of the settings. Their names are the operator's words for the controls.
BUTTONS = ("lower", "upper")
TRIGGERS = ("trigger", "grip")
HELD = (*TRIGGERS, "stick_up", "stick_down", "stick_left", "stick_right")
CONTROLS = (*BUTTONS, *HELD)
# For each control, the button or axis of a device, and the sign of the axis in the direction of the control.
DEVICE_NAMES: dict[str, tuple[str, float]] = {
    "lower": ("button_lower", 1.0),
    "upper": ("button_upper", 1.0),
    "trigger": ("press_index", 1.0),
    "grip": ("press_middle", 1.0),
    "stick_up": ("thumb_stick_vertical", 1.0),
    "stick_down": ("thumb_stick_vertical", -1.0),
    "stick_left": ("thumb_stick_horizontal", -1.0),
    "stick_right": ("thumb_stick_horizontal", 1.0),
}
_SUFFIXES = {Gesture.TAP: "", Gesture.HOLD: "_hold"}


class Binding(NamedTuple):
    """One gesture of one control, and its action."""

    control: str
    gesture: Gesture
    action: Action

    @property
    def field(self) -> str:
        """The name of the setting that contains this binding, within the block ``teleop.bindings``."""
        return ("" if self.control in CONTROLS else "device.") + self.control + _SUFFIXES[self.gesture]

    @property
    def words(self) -> str:
        """The operator's words for this gesture of the control."""
        return f"{self.control} held" if self.gesture is Gesture.HOLD else self.control


class BindingSettings(StrictModel):
    """The actions of each hand's controls. An action has at most one gesture, and one control has to engage the arm."""

    lower: Action = Field(
        Action.PAUSE_TOGGLE, description="A or X, tapped: an action that is done once, except stop; or none"
    )
    lower_hold: Action = Field(
        Action.NONE, description="held for hold_time: an action that is done once, except pause_toggle; or none"
    )
    upper: Action = Field(Action.GRIPPER_TOGGLE, description="B or Y, as lower")
    upper_hold: Action = Field(Action.NONE, description="as lower_hold")
    trigger: Action = Field(
        Action.NONE,
        description="index finger; while held: dead_man, precision, rotation_lock, translation_lock, gripper_analog; "
        "tapped: what is done once; or none",
    )
    trigger_hold: Action = Field(
        Action.NONE, description="as lower_hold, if trigger has no action that lasts while it is held"
    )
    grip: Action = Field(Action.NONE, description="middle finger, as trigger")
    grip_hold: Action = Field(Action.NONE, description="as trigger_hold")
    stick_up: Action = Field(Action.NONE, description="thumb stick forward, as trigger, but not gripper_analog")
    stick_up_hold: Action = Field(Action.NONE, description="as trigger_hold")
    stick_down: Action = Field(Action.NONE, description="as stick_up")
    stick_down_hold: Action = Field(Action.NONE, description="as trigger_hold")
    stick_left: Action = Field(Action.NONE, description="as stick_up")
    stick_left_hold: Action = Field(Action.NONE, description="as trigger_hold")
    stick_right: Action = Field(Action.NONE, description="as stick_up")
    stick_right_hold: Action = Field(Action.NONE, description="as trigger_hold")
    device: dict[str, Action] = Field(
        default_factory=dict,
        description="actions of NAME and NAME_hold, for each button or axis NAME that only the input device has",
    )

    @model_validator(mode="after")
    def _mean_one_thing(self) -> BindingSettings:
        if taken := {*self.of_device} & {*CONTROLS, *QUEST_CONTROLS.names}:
            raise ValueError(f"device.{min(taken)}: a control of every headset; allowed: {', '.join(CONTROLS)}")
        bound: dict[str, Binding] = {}
        for binding in self.bound():
            if other := bound.get(binding.action):
                raise ValueError(f"{other.field} and {binding.field} are both {binding.action}; allowed: one of them")
            bound[binding.action] = binding
            self._allow(binding)
        toggle, dead_man = bound.get(Action.PAUSE_TOGGLE), bound.get(Action.DEAD_MAN)
        if toggle and dead_man:
            both = f"{toggle.field} is pause_toggle and {dead_man.field} is dead_man"
            raise ValueError(f"{both}; allowed: one way to engage")
        if not (toggle or dead_man):
            raise ValueError("no control engages the arm; allowed: a control that is pause_toggle, or dead_man")
        analog = bound.get(Action.GRIPPER_ANALOG)
        if analog and (other := bound.get(Action.GRIPPER_TOGGLE)):
            both = f"{other.field} is gripper_toggle and {analog.field} is gripper_analog"
            raise ValueError(f"{both}; allowed: one of them")
        return self

    def _allow(self, binding: Binding) -> None:
        """Raise ValueError if the gesture is too slow, too coarse or too ambiguous for its action."""
        control, gesture, action = binding
        if action is Action.PAUSE_TOGGLE and gesture is not Gesture.TAP:
            raise ValueError(f"{binding.field} is pause_toggle, which must not wait; allowed: {control}")
        if action is Action.STOP and control in BUTTONS and gesture is Gesture.TAP:
            why = "and the headset's alignment presses it too"
            raise ValueError(f"{control} is stop, {why}; allowed: {control}_hold, or another control")
        if action in LASTING and (gesture is not Gesture.TAP or control in BUTTONS):
            raise ValueError(f"{binding.field} is {action}, which lasts; allowed: {', '.join(HELD)}")
        if action is Action.GRIPPER_ANALOG and control in CONTROLS and control not in TRIGGERS:
            raise ValueError(f"{control} is gripper_analog; allowed: trigger or grip")
        if action in LASTING:
            for other in self.bound():
                if other.control == control and other.gesture is not Gesture.TAP:
                    raise ValueError(f"{control} is {action} and {other.field} is {other.action}; allowed: one of them")

    def check_device(self, controls: DeviceControls, device: str = "this input") -> None:
        """Raise :class:`ConfigError` for a binding to a control that an input device does not have."""
        allowed = {control: control for control, (name, _) in DEVICE_NAMES.items() if name in controls.names}
        allowed |= {name: f"device.{name}" for name in controls.names if name not in QUEST_CONTROLS.names}
        for binding in self.bound():
            if binding.control not in allowed:
                no, _ = DEVICE_NAMES.get(binding.control, (binding.control, 1.0))
                has = ", ".join(allowed.values()) or "no control at all"
                key = f"teleop.bindings.{binding.field}"
                raise ConfigError(f"{key} = {binding.action}: {device} has no {no}; allowed: {has}")

    def bound(self) -> Iterator[Binding]:
        """Yield all bindings, control by control."""
        for control in (*CONTROLS, *self.of_device):
            for gesture in _SUFFIXES:
                if (action := self.action_of(control, gesture)) is not Action.NONE:
                    yield Binding(control, gesture, action)

    @property
    def of_device(self) -> tuple[str, ...]:
        """The names of the controls in the block ``device``. A control with two gestures is named once."""
        return tuple(dict.fromkeys(key.removesuffix(_SUFFIXES[Gesture.HOLD]) for key in self.device))

    def meanings(self) -> dict[str, str]:
        """Return the action of each bound gesture in words, by the operator's words for the gesture."""
        words = {binding.words: MEANINGS[binding.action] for binding in self.bound()}
        return words | {"lower and upper together": "the headset's alignment: stops both arms until they are let go"}

    def action_of(self, control: str, gesture: Gesture) -> Action:
        """Return the action of a control's gesture. The gesture ``DOWN`` has no action."""
        if gesture is Gesture.DOWN:
            return Action.NONE
        key = control + _SUFFIXES[gesture]
        return getattr(self, key) if control in CONTROLS else self.device.get(key, Action.NONE)

    def words_of(self, action: str) -> str | None:
        """Return the operator's words for the gesture to which an action is bound; None if it is not bound."""
        return next((binding.words for binding in self.bound() if binding.action == action), None)
