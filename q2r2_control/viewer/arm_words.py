"""In words why an arm moves or does not, and what its operator's next press does."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from q2r2_control.config.bindings import Action, BindingSettings
from q2r2_control.events import REFUSALS, Event
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.arm_states import ArmState
from q2r2_control.types import ActiveLimit, LimitKind
from q2r2_control.wording import sentence

# A tool nearer to its target than this follows; what holds it back beyond that is said [m], [rad].
_FOLLOWS, _TURNED = 0.005, 0.05
_HELD_BY = {LimitKind.POSITION: "at its limit", LimitKind.VELOCITY: "as fast as it may turn"}


def why(tick: Tick, arm: str, joints: Collection[str], binding: Collection[ActiveLimit], last: Event | None) -> str:
    """Why ``arm``, whose joints have these names, is where it is.

    ``binding``: limits and pairs that held the last steps back, as in a report; ``last``: its last event.
    """
    if not tick.following:
        return "the run ends"
    if tick.states[arm] in (ArmState.ALIGNING, ArmState.HOMING):
        return tick.states[arm]
    if not tick.engaged[arm]:
        if last is None:
            return "not engaged yet"
        return sentence(last.reason) if last.kind in REFUSALS else f"{tick.states[arm]}: {sentence(last.reason)}"
    distance, angle = tick.tracking_error(arm)
    if not (distance > _FOLLOWS or angle > _TURNED):
        return "goes with the other arm" if tick.states[arm] == ArmState.CARRIED else "follows the hand"
    return _held_by(tick, arm, joints, binding) or ("catches up" if np.isfinite(distance) else "holds")


def next_press(tick: Tick, arm: str, bindings: BindingSettings) -> str:
    """The effect of the next press of each button of the arm's hand, and of its dead man."""
    state = tick.states[arm]
    if not tick.connected:
        return "nothing: no input is connected"
    if state == ArmState.ALIGNING:
        return "release both buttons to go on"
    if state == ArmState.HOMING:
        return "any press stops the way home"
    if state == ArmState.CARRIED:
        return f"{bindings.words_of(Action.CARRY)} of either hand ends it, or a pause"
    if state == ArmState.STOPPED:
        return f"{bindings.words_of(Action.STOP)} goes on"
    moves = state in (ArmState.ENGAGED, ArmState.PAUSING)
    words = {
        Action.PAUSE_TOGGLE: "pauses" if moves else "engages",
        Action.GRIPPER_TOGGLE: "opens the gripper" if tick.targets[arm].gripper < 0.5 else "closes the gripper",
        Action.DEAD_MAN: "let go pauses" if moves else "held engages",
    }
    bound = ((bindings.words_of(action), what) for action, what in words.items())
    return ", ".join(f"{control} {what}" for control, what in bound if control is not None)


def _held_by(tick: Tick, arm: str, joints: Collection[str], binding: Collection[ActiveLimit]) -> str | None:
    """The pair or limit of an arm that is nearest to what moves the tool, if any is at work."""
    report = tick.reference.report
    pairs = [limit.names for limit in binding if limit.kind is LimitKind.SEPARATION]
    pairs = [pair for pair in pairs if any(body.startswith(f"{arm}_") for body in pair)]
    if report.tightest_pair in pairs:
        return f"held by {' | '.join(report.tightest_pair)}, {1e3 * report.margin:.0f} mm to spare"
    if pairs:
        return f"held by {' | '.join(pairs[0])}"
    for kind, words in _HELD_BY.items():
        if mine := [limit.names[0] for limit in binding if limit.kind is kind and limit.names[0] in joints]:
            return f"{mine[0]} {words}"
    return None
