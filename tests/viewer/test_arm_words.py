"""Sentences about an arm: the reason for its state, and the operator's next steps in the words of the device."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from q2r2_control.config.bindings import BindingSettings
from q2r2_control.device_words import QUEST_WORDS, DeviceWords
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.inputs.web import WebInput, web_cell
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import ActiveLimit, ArmTarget, LimitKind
from q2r2_control.viewer.arm_words import ArmWords
from tests.support.processes import cell
from tests.viewer.conftest import tick_at

JOINTS = {side: [f"{side}_A{number}" for number in range(1, 8)] for side in ("left", "right")}

FAST = ActiveLimit(LimitKind.VELOCITY, ("left_A2",))
AT_LIMIT = ActiveLimit(LimitKind.POSITION, ("left_A4",))
NEAR_TABLE = ActiveLimit(LimitKind.SEPARATION, ("left_hand_0", "table_0"))
NEAR_ARM = ActiveLimit(LimitKind.SEPARATION, ("left_link_5_0", "right_link_5_0"))
OTHER_ARM = ActiveLimit(LimitKind.SEPARATION, ("right_link_1_0", "right_link_5_0"))


def words(tick: Tick, *binding: ActiveLimit, told: tuple[Event, ...] = ()) -> str:
    made = ArmWords(JOINTS, BindingSettings(), QUEST_WORDS)
    made.follow(told)
    return made.why(tick, "left", binding)


@pytest.mark.parametrize(
    ("binding", "expected"),
    [
        ((ActiveLimit(LimitKind.POSITION, ("right_A4",)), OTHER_ARM), "catches up"),
        ((ActiveLimit(LimitKind.ACCELERATION, ("left_A4",)),), "catches up"),
        ((AT_LIMIT, FAST), "left_A4 at its limit"),
        ((FAST,), "left_A2 as fast as it may turn"),
        ((FAST, NEAR_TABLE), "held by left_hand_0 | table_0"),
        ((NEAR_TABLE, NEAR_ARM), "held by left_link_5_0 | right_link_5_0, 82 mm to spare"),
    ],
)
def test_for_an_arm_away_from_its_target_the_sentence_names_the_limit_that_holds_the_arm_back(
    robot: Robot, binding: tuple[ActiveLimit, ...], expected: str
) -> None:
    assert words(tick_at(robot, 1.0), *binding) == expected


def test_for_an_arm_at_its_target_the_sentence_says_that_the_arm_follows_whatever_limits_are_active(
    robot: Robot,
) -> None:
    tick = tick_at(robot, 1.0)
    targets = {arm: ArmTarget(pose, 1.0) for arm, pose in tick.tools.items()}
    assert words(replace(tick, targets=targets), FAST) == "follows the hand"


@pytest.mark.parametrize(
    ("source", "destination", "kind", "expected"),
    [
        ("engaged", "lost", TeleopReason.CONNECTION_LOST, "connection lost"),
        ("aligning", "engaged", TeleopReason.ALIGNED, "aligned anew"),
        ("paused", "paused", TeleopReason.NO_RECORDING, TeleopReason.NO_RECORDING.template),
    ],
)
def test_for_an_arm_that_is_not_engaged_the_sentence_gives_the_reason_of_its_stop(
    robot: Robot, source: str, destination: str, kind: ReasonKind, expected: str
) -> None:
    paused = replace(tick_at(robot, 1.0, engaged=False), states={"left": destination, "right": "idle"})
    assert words(paused, told=(Event(0.5, "left", source, destination, Reason(kind)),)) == expected


def test_the_sentence_says_that_an_arm_is_not_engaged_yet_or_aligns_or_that_the_run_ends(robot: Robot) -> None:
    paused = tick_at(robot, 1.0, engaged=False)
    assert words(paused) == "not engaged yet"
    aligning = replace(paused, states={"left": "aligning", "right": "aligning"})
    chord = Event(0.5, "left", "engaged", "aligning", Reason(TeleopReason.ALIGNMENT_CHORD))
    assert words(aligning, told=(chord,)) == "aligning"
    assert words(replace(paused, following=False)) == "the run ends"
    assert press(aligning) == "release both buttons to go on"


def test_a_reason_stays_until_the_state_changes_and_the_reason_of_a_refusal_is_added_to_it(robot: Robot) -> None:
    lost = replace(tick_at(robot, 1.0, engaged=False), states={"left": "lost", "right": "lost"})
    silent = Event(0.5, "left", "engaged", "lost", Reason.of(TeleopReason.POSE_SILENT, timeout=0.15))
    changed = Event(0.6, "left", "lost", "lost", Reason(TeleopReason.CONTROL_CHANGED))
    refused = Event(0.7, "left", "lost", "lost", Reason(TeleopReason.NOT_ENGAGED, cause=Reason(TeleopReason.NO_POSE)))
    paused = Event(0.8, "left", "lost", "paused", Reason(TeleopReason.PAUSE_REQUESTED))
    assert words(lost, told=(silent, changed)) == "no pose for 0.15 s"
    both = "no pose for 0.15 s; not engaged: the newest pose is not usable"
    assert words(lost, told=(silent, changed, refused)) == both
    assert words(lost, told=(silent, refused, paused)) == "a program asks for a pause"


def test_if_a_paused_arm_is_asked_to_pause_the_answer_is_shown_for_a_short_time(robot: Robot) -> None:
    request, pause = Reason(TeleopReason.PAUSE_REQUESTED), Reason(TeleopReason.PAUSE_SERVICE)
    lost = replace(tick_at(robot, 1.0, engaged=False), states={"left": "lost", "right": "idle"})
    asked = Event(0.5, "left", "engaged", "engaged", request)
    stops = Event(0.5, "left", "engaged", "lost", request)
    assert words(lost, told=(asked, stops)) == "a program asks for a pause"
    again = Event(0.9, "left", "lost", "lost", request)
    assert words(lost, told=(asked, stops, again)) == "a program asks for a pause; already paused"
    assert words(replace(lost, t=5.0), told=(asked, stops, again)) == "a program asks for a pause"
    idle = replace(lost, states={"left": "idle", "right": "idle"})
    assert words(idle, told=(Event(0.9, "left", "idle", "idle", pause),)) == "not engaged yet; already paused"


def test_a_reason_names_a_control_as_the_operator_knows_it(robot: Robot) -> None:
    paused = tick_at(robot, 1.0, engaged=False)
    pressed = Event(0.5, "left", "pausing", "paused", Reason.of(TeleopReason.PRESSED, control="lower button"))
    assert words(paused, told=(pressed,)) == "A or X"


def press(tick: Tick, bindings: Mapping[str, str] = {}, device: DeviceWords = QUEST_WORDS) -> str:
    return ArmWords(JOINTS, BindingSettings.model_validate(bindings), device).next_press(tick, "left")


def test_the_text_about_the_next_press_depends_on_the_state_of_the_arm_and_of_its_gripper(robot: Robot) -> None:
    engaged, paused = tick_at(robot, 1.0), tick_at(robot, 1.0, engaged=False)
    assert press(engaged) == "press A or X to pause, press B or Y to close the gripper"
    closed = {arm: ArmTarget(None, 0.0) for arm in paused.targets}
    assert press(replace(paused, targets=closed)) == "press A or X to engage, press B or Y to open the gripper"
    assert press(replace(paused, connected=False)) == "nothing: no headset is connected"


def test_the_text_about_the_next_press_names_the_control_that_is_bound(robot: Robot) -> None:
    engaged, paused = tick_at(robot, 1.0), tick_at(robot, 1.0, engaged=False)
    swapped = {"lower": "gripper_toggle", "upper": "pause_toggle"}
    assert press(paused, swapped) == "press B or Y to engage, press A or X to close the gripper"
    dead_man = {"lower": "none", "upper": "none", "grip": "dead_man", "trigger": "precision"}
    assert press(paused, dead_man) == "hold the grip to engage"
    assert press(engaged, dead_man) == "let go of the grip to pause"


def test_for_a_page_the_sentences_name_its_arrows_and_rings_even_before_they_are_dragged(robot: Robot) -> None:
    waits = replace(tick_at(robot, 1.0, engaged=False), connected=False)
    made = ArmWords(JOINTS, web_cell(cell()).teleop.bindings, WebInput.controls.words)
    assert made.next_press(waits, "left").startswith("drag a tool's arrows or rings to engage")
    assert made.next_press(tick_at(robot, 1.0), "left").startswith("let go of a tool's arrows or rings to pause")
    made.follow([Event(0.5, "left", "engaged", "paused", Reason(TeleopReason.DEAD_MAN_RELEASED))])
    assert made.why(waits, "left", ()) == "a tool's arrows or rings let go"
    assert "lower" not in str(made.controls())


def test_no_operator_is_asked_to_press_what_a_script_presses(robot: Robot) -> None:
    scripted = replace(QUEST_WORDS, nobody="a script moves the hands")
    assert press(tick_at(robot, 1.0), {}, scripted) == "nothing: a script moves the hands"
