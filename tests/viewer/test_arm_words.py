"""What an operator reads of an arm: why it does not follow, and what the next press does."""

from __future__ import annotations

from dataclasses import replace

import pytest

from q2r2_control.config.bindings import BindingSettings
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit, ArmTarget, LimitKind
from q2r2_control.viewer.live import next_press, why
from tests.viewer.ticks import tick_at

JOINTS = ("left_A2", "left_A4")


def position(joint: str) -> ActiveLimit:
    return ActiveLimit(LimitKind.POSITION, (joint,))


def velocity(joint: str) -> ActiveLimit:
    return ActiveLimit(LimitKind.VELOCITY, (joint,))


def pair(*bodies: str) -> ActiveLimit:
    return ActiveLimit(LimitKind.SEPARATION, bodies)


def words(tick: Tick, *binding: ActiveLimit, last: Event | None = None) -> str:
    return why(tick, "left", JOINTS, binding, last)


@pytest.mark.parametrize(
    ("binding", "expected"),
    [
        ((), "catches up"),
        ((position("right_A4"), pair("right_link_1_0", "right_link_5_0")), "catches up"),
        ((ActiveLimit(LimitKind.ACCELERATION, ("left_A4",)),), "catches up"),
        ((position("left_A4"), velocity("left_A2")), "left_A4 at its limit"),
        ((velocity("left_A2"),), "left_A2 as fast as it may turn"),
        ((velocity("left_A2"), pair("left_hand_0", "table_0")), "held by left_hand_0 | table_0"),
        (
            (pair("left_hand_0", "table_0"), pair("left_link_5_0", "right_link_5_0")),
            "held by left_link_5_0 | right_link_5_0, 82 mm to spare",
        ),
    ],
)
def test_an_arm_that_is_away_from_its_target_is_held_by_what_is_at_work_on_it(
    robot: Robot, binding: tuple[ActiveLimit, ...], expected: str
) -> None:
    assert words(tick_at(robot, 1.0), *binding) == expected


def test_an_arm_that_is_at_its_target_follows_whatever_is_at_work(robot: Robot) -> None:
    tick = tick_at(robot, 1.0)
    targets = {arm: ArmTarget(pose, 1.0) for arm, pose in tick.tools.items()}
    assert words(replace(tick, targets=targets), velocity("left_A2")) == "follows the hand"


@pytest.mark.parametrize(
    ("source", "destination", "kind", "expected"),
    [
        ("engaged", "lost", ReasonKind.CONNECTION_LOST, "lost: connection lost"),
        ("aligning", "engaged", ReasonKind.ALIGNED, "engaged: aligned anew"),
        ("paused", "paused", ReasonKind.NO_RECORDING, ReasonKind.NO_RECORDING.template),
    ],
)
def test_an_arm_that_is_not_engaged_says_what_stopped_it(
    robot: Robot, source: str, destination: str, kind: ReasonKind, expected: str
) -> None:
    paused = replace(tick_at(robot, 1.0, engaged=False), states={"left": destination, "right": "idle"})
    assert words(paused, last=Event(0.5, "left", source, destination, Reason(kind))) == expected


def test_before_its_first_event_and_while_aligning_it_says_so_too(robot: Robot) -> None:
    paused = tick_at(robot, 1.0, engaged=False)
    assert words(paused) == "not engaged yet"
    aligning = replace(paused, states={"left": "aligning", "right": "aligning"})
    assert (
        words(aligning, last=Event(0.5, "left", "engaged", "aligning", Reason(ReasonKind.ALIGNMENT_CHORD)))
        == "aligning"
    )
    assert words(replace(paused, following=False)) == "the run ends"
    assert press(aligning) == "release both buttons to go on"


def press(tick: Tick, **bindings: str) -> str:
    return next_press(tick, "left", BindingSettings.model_validate(bindings))


def test_the_next_press_is_told_by_state_and_gripper(robot: Robot) -> None:
    engaged, paused = tick_at(robot, 1.0), tick_at(robot, 1.0, engaged=False)
    assert press(engaged) == "lower pauses, upper closes the gripper"
    closed = {arm: ArmTarget(None, 0.0) for arm in paused.targets}
    assert press(replace(paused, targets=closed)) == "lower engages, upper opens the gripper"
    assert press(replace(paused, connected=False)) == "nothing: no input is connected"


def test_the_next_press_is_that_of_the_control_that_is_bound(robot: Robot) -> None:
    engaged, paused = tick_at(robot, 1.0), tick_at(robot, 1.0, engaged=False)
    assert press(paused, lower="gripper_toggle", upper="pause_toggle") == "upper engages, lower closes the gripper"
    dead_man = {"lower": "none", "upper": "none", "grip": "dead_man", "trigger": "precision"}
    assert press(paused, **dead_man) == "grip held engages"
    assert press(engaged, **dead_man) == "grip let go pauses"
