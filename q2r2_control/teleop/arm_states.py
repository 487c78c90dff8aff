"""The states of an arm, and a table of the causes that lead from one state to another. The docs show this table."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

from q2r2_control.events import Event
from q2r2_control.teleop.reasons import REFUSALS


class ArmState(StrEnum):
    """The state of one arm. The arm holds in every state except ENGAGED, CARRIED, POLICY and HOMING."""

    IDLE = "idle"  # The arm was never engaged.
    ENGAGED = "engaged"
    PAUSING = "pausing"  # A button has stopped the arm, and may still become a chord or another gesture.
    PAUSED = "paused"
    ALIGNING = "aligning"  # The alignment chord has stopped the arm. The arm is engaged when the buttons are released.
    CARRIED = "carried"  # The arm moves with the other arm, which is engaged: one hand moves both.
    POLICY = "policy"  # The arm follows the actions of a policy.
    HOMING = "homing"
    LOST = "lost"  # A fault has stopped the arm.
    STOPPED = "stopped"  # The operator has stopped the arm, and has to end the stop.


class Cause(StrEnum):
    """The causes that change the state of an arm, in the words of the docs."""

    PAUSE_BEGINS = "the control that pauses goes down"
    PAUSE = "it was that control's gesture, and no chord"
    ENGAGE = "the control that engages, with nothing in the way"
    LET_GO = "the dead man is let go"
    CHORD = "the headset's alignment: both buttons of a hand"
    ALIGNED = "both buttons are released, and a new pose has come"
    NOT_ALIGNED = "the same, but a condition for engaging is not met"
    CARRY = "the control that carries, by the hand of the other arm, which is engaged"
    CARRY_ENDS = "that control, one that pauses or an alignment, by either hand"
    GIVE_BACK = "a program gives the arms to the policy"
    POLICY_ACTS = "an action of a policy counts, with nothing in the way"
    HOME = "the control that brings the arms home, with nothing in the way"
    HOMED = "home, or held up on the way"
    PRESS = "any press"
    STOP = "the control that stops"
    GO_ON = "the control that stops, once more"
    FAULT = "data lost or not usable, a jump, a stall, or the arm's controller has stopped"


class Who(StrEnum):
    """Which arms change their state in a transition."""

    ARM = "the arm"
    LINKED = "both arms; with `linked: false` the arm"
    BOTH = "both arms"


class Transition(NamedTuple):
    """One row of the table: ``cause`` leads from each state of ``sources`` to ``destination``."""

    sources: frozenset[ArmState]
    cause: Cause
    destination: ArmState
    who: Who = Who.ARM


_S = ArmState
AT_REST = frozenset({_S.IDLE, _S.PAUSED, _S.LOST})  # An arm in one of these states may be engaged.
HOLDING = AT_REST | {_S.STOPPED}
FOLLOWING = frozenset({_S.ENGAGED, _S.PAUSING, _S.ALIGNING, _S.CARRIED, _S.POLICY})
TRANSITIONS = (
    Transition(AT_REST | {_S.POLICY}, Cause.ENGAGE, _S.ENGAGED),
    Transition(frozenset({_S.ENGAGED}), Cause.PAUSE_BEGINS, _S.PAUSING),
    Transition(frozenset({_S.PAUSING}), Cause.PAUSE, _S.PAUSED),
    Transition(frozenset({_S.ENGAGED, _S.ALIGNING}), Cause.LET_GO, _S.PAUSED),
    Transition(frozenset({_S.ENGAGED, _S.PAUSING}), Cause.CHORD, _S.ALIGNING, Who.BOTH),
    Transition(frozenset({_S.ALIGNING}), Cause.ALIGNED, _S.ENGAGED),
    Transition(frozenset({_S.ALIGNING}), Cause.NOT_ALIGNED, _S.LOST),
    Transition(AT_REST | {_S.ENGAGED}, Cause.CARRY, _S.CARRIED),
    Transition(frozenset({_S.ENGAGED, _S.CARRIED}), Cause.CARRY_ENDS, _S.PAUSED, Who.BOTH),
    Transition(frozenset({_S.ENGAGED, _S.PAUSING, _S.ALIGNING, _S.LOST}), Cause.GIVE_BACK, _S.PAUSED, Who.BOTH),
    Transition(AT_REST, Cause.POLICY_ACTS, _S.POLICY),
    Transition(FOLLOWING, Cause.FAULT, _S.LOST, Who.LINKED),
    Transition(AT_REST | {_S.ENGAGED, _S.PAUSING, _S.POLICY}, Cause.HOME, _S.HOMING, Who.BOTH),
    Transition(frozenset({_S.HOMING}), Cause.HOMED, _S.PAUSED, Who.BOTH),
    Transition(frozenset({_S.HOMING}), Cause.PRESS, _S.PAUSED, Who.BOTH),
    Transition(frozenset({_S.HOMING}), Cause.FAULT, _S.LOST, Who.BOTH),
    Transition(frozenset(_S) - {_S.STOPPED}, Cause.STOP, _S.STOPPED, Who.BOTH),
    Transition(frozenset({_S.STOPPED}), Cause.GO_ON, _S.PAUSED, Who.BOTH),
)
_NEXT = {(source, line.cause): line.destination for line in TRANSITIONS for source in line.sources}


def next_state(state: ArmState, cause: Cause) -> ArmState:
    """Return the state to which ``cause`` leads from ``state``; ``state`` itself if the cause has no effect in it."""
    return _NEXT.get((state, cause), state)


def is_refusal(event: Event) -> bool:
    """Return whether the event is a refused request of the operator, so that no state changed."""
    return event.kind in REFUSALS and event.source == event.destination


def is_fault(event: Event) -> bool:
    """Return whether a fault has stopped an arm, or a press was refused."""
    return (event.destination == ArmState.LOST and event.source != event.destination) or is_refusal(event)
