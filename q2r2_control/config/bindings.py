"""What each control of a hand does: one thing, or nothing."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field, model_validator


class ButtonAction(StrEnum):
    """What a press of the upper or lower button does."""

    NONE = "none"
    PAUSE_TOGGLE = "pause_toggle"  # engage, or pause
    GRIPPER_TOGGLE = "gripper_toggle"


class HeldAction(StrEnum):
    """What lasts for as long as a trigger or stick is held."""

    NONE = "none"
    DEAD_MAN = "dead_man"  # engaged while held
    PRECISION = "precision"  # motion is scaled down
    ROTATION_LOCK = "rotation_lock"  # the tool keeps its orientation
    TRANSLATION_LOCK = "translation_lock"  # the tool keeps its position


# What an operator reads of each action.
MEANINGS: dict[str, str] = {
    ButtonAction.PAUSE_TOGGLE: "engages the arm where it is, or pauses it",
    ButtonAction.GRIPPER_TOGGLE: "closes the gripper, or opens it",
    HeldAction.DEAD_MAN: "held: the arm follows; let go: it pauses",
    HeldAction.PRECISION: "held: motion is scaled by precision_scale",
    HeldAction.ROTATION_LOCK: "held: the tool keeps its orientation",
    HeldAction.TRANSLATION_LOCK: "held: the tool keeps its position",
}
# Fields of the settings, which name the controls as an operator does.
BUTTONS = ("lower", "upper")
HELD = ("trigger", "grip", "stick_up", "stick_down", "stick_left", "stick_right")


class BindingSettings(BaseModel):
    """The controls of each hand. An action is bound to one control at most, and something has to engage the arm."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    lower: ButtonAction = Field(ButtonAction.PAUSE_TOGGLE, description="A or X: pause_toggle, gripper_toggle or none")
    upper: ButtonAction = Field(ButtonAction.GRIPPER_TOGGLE, description="B or Y: the same")
    trigger: HeldAction = Field(
        HeldAction.NONE,
        description="index finger, while held: dead_man, precision, rotation_lock, translation_lock or none",
    )
    grip: HeldAction = Field(HeldAction.NONE, description="middle finger, the same")
    stick_up: HeldAction = Field(HeldAction.NONE, description="thumb stick forward, the same")
    stick_down: HeldAction = Field(HeldAction.NONE, description="the same")
    stick_left: HeldAction = Field(HeldAction.NONE, description="the same")
    stick_right: HeldAction = Field(HeldAction.NONE, description="the same")

    @model_validator(mode="after")
    def _mean_one_thing(self) -> BindingSettings:
        bound: dict[str, str] = {}
        for control in (*BUTTONS, *HELD):
            action = str(getattr(self, control))
            if action == ButtonAction.NONE:
                continue
            if action in bound:
                raise ValueError(f"{bound[action]} and {control} are both {action}; allowed: one of them")
            bound[action] = control
        toggle, dead_man = bound.get(ButtonAction.PAUSE_TOGGLE), bound.get(HeldAction.DEAD_MAN)
        if toggle and dead_man:
            raise ValueError(f"{toggle} is pause_toggle and {dead_man} is dead_man; allowed: one way to engage")
        if not (toggle or dead_man):
            raise ValueError("no control engages the arm; allowed: a button that is pause_toggle, or dead_man")
        return self

    def meanings(self) -> dict[str, str]:
        """In words what each control of a hand does that does something."""
        bound = {control: str(getattr(self, control)) for control in (*BUTTONS, *HELD)}
        words = {control: MEANINGS[action] for control, action in bound.items() if action != ButtonAction.NONE}
        return words | {"lower and upper together": "the headset's alignment: stops both arms until they are let go"}

    def control_of(self, action: str) -> str | None:
        """The control that an action is bound to."""
        return next((control for control in (*BUTTONS, *HELD) if getattr(self, control) == action), None)
