"""The transitions between the states of an arm. The docs show the same table."""

from __future__ import annotations

import re

import pytest

from q2r2_control.teleop.arm_states import TRANSITIONS, ArmState, Cause, Transition, Who, next_state
from tests.support.docs import table_rows

# States in which an arm holds.
RESTS = set(ArmState) - {ArmState.ENGAGED, ArmState.CARRIED, ArmState.POLICY, ArmState.HOMING}


def documented(sources: str, cause: str, destination: str, who: str) -> Transition:
    """Return the transition that a row of the table in the docs describes."""
    named = frozenset(map(ArmState, re.findall(r"`(\w+)`", sources)))
    states = set(ArmState) - named if "any but" in sources else named
    return Transition(frozenset(states), Cause(cause), ArmState(destination.strip("`")), Who(who))


def test_the_transitions_in_the_docs_equal_the_transitions_in_the_code() -> None:
    rows = table_rows("operator.md")
    assert {documented(*row) for row in rows if row[-1] in list(Who)} == set(TRANSITIONS)


def test_no_cause_has_two_transitions_from_the_same_state() -> None:
    ways = [(source, line.cause) for line in TRANSITIONS for source in line.sources]
    assert len(ways) == len(set(ways))
    assert {line.cause for line in TRANSITIONS} == set(Cause)
    assert {line.destination for line in TRANSITIONS} | {ArmState.IDLE} == set(ArmState)


def test_only_an_operator_or_a_policy_can_start_the_motion_of_an_arm() -> None:
    begins = {line.cause for line in TRANSITIONS if line.destination not in RESTS and line.sources & RESTS}
    assert begins == {Cause.ENGAGE, Cause.ALIGNED, Cause.CARRY, Cause.POLICY_ACTS, Cause.HOME}


@pytest.mark.parametrize("state", ArmState)
def test_a_stop_works_in_every_state_and_ends_only_when_its_control_is_pressed_again(state: ArmState) -> None:
    assert next_state(state, Cause.STOP) is ArmState.STOPPED
    ends = [cause for cause in Cause if next_state(ArmState.STOPPED, cause) is not ArmState.STOPPED]
    assert ends == [Cause.GO_ON]


@pytest.mark.parametrize("state", sorted(set(ArmState) - RESTS))
@pytest.mark.parametrize("cause", [Cause.FAULT, Cause.STOP])
def test_every_moving_state_is_stopped_by_a_fault_and_by_a_stop(state: ArmState, cause: Cause) -> None:
    assert next_state(state, cause) in RESTS
    assert next(line.who for line in TRANSITIONS if state in line.sources and line.cause is cause) is not Who.ARM
