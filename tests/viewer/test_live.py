"""The live table: what it shows, and how it is drawn on a real terminal, one end of a pseudo-terminal."""

from __future__ import annotations

import os
import pty
import sys
import threading
import time
from contextlib import redirect_stderr, suppress
from dataclasses import replace

import pytest
from rich.console import Console

from q2r2_control.config.bindings import BindingSettings
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import ActiveLimit, ArmTarget, LimitKind
from q2r2_control.viewer.live import LiveTable, next_press, why
from tests.cli.test_output import printed
from tests.viewer.conftest import tick_at

JOINTS = {side: [f"{side}_A{number}" for number in range(1, 8)] for side in ("left", "right")}


def test_it_shows_states_errors_distances_and_grippers_of_the_newest_tick(robot: Robot) -> None:
    table = LiveTable("demo", JOINTS, BindingSettings())
    table(tick_at(robot, 1.0, engaged=False))
    table(replace(tick_at(robot, 2.0, distance=0.0234), held_grippers={"left": ("left_finger_0", "block_0")}))
    text = printed(table.render(), 120)
    for expected in (
        *("demo", "engaged", "3.0 mm", "5.73 deg", "50 %", "23.4 mm", "left_hand_0 | table_0", "2.0 s"),
        *("5.4 mm to spare", "left_link_5_0 | right_link_5_0", "left_finger_0 | block_0"),
    ):
        assert expected in text
    assert "paused" not in text


def test_names_and_progress_are_whole_in_80_columns(robot: Robot) -> None:
    table = LiveTable("demo", JOINTS, BindingSettings(), ((0.0, "meet: both grasp"),), 10.0)
    tick = tick_at(robot, 2.5)
    pair = ("right_hand_e_finger_1_envelope_0", "left_hand_e_finger_1_envelope_0")
    report = replace(tick.reference.report, closest_pair=pair)
    table(replace(tick, reference=replace(tick.reference, report=report)))
    assert "…" not in printed(table.render(), 80)


def test_it_shows_each_arm_s_session_with_its_cabinet(robot: Robot) -> None:
    table = LiveTable("demo", JOINTS, BindingSettings())
    sessions = {"left": "commanding active, connection good, drives active", "right": "not heard"}
    table(replace(tick_at(robot, 0.0), sessions=sessions))
    text = printed(table.render(), 160)
    assert "not heard" in text
    assert sessions["left"] in text


def test_it_shows_the_step_of_the_work_and_how_much_of_it_is_done(robot: Robot) -> None:
    steps = ((0.0, "stack: the left hand reaches for a block"), (2.0, "stack: it grasps"), (3.0, "stack: it lifts"))
    table = LiveTable("demo", JOINTS, BindingSettings(), steps, 10.0)
    table(tick_at(robot, 2.5))
    text = printed(table.render(), 120)
    assert "stack: it grasps" in text
    assert "━" * 5 + "·" * 15 + " 25%" in text


def test_it_shows_every_limit_that_was_at_work_since_it_was_drawn_last(robot: Robot) -> None:
    table = LiveTable("demo", JOINTS, BindingSettings())
    tick = tick_at(robot, 0.0)
    report = replace(tick.reference.report, binding=(ActiveLimit(LimitKind.VELOCITY, ("left_A2",)),))
    table(replace(tick, reference=replace(tick.reference, report=report)))
    table(tick)
    assert "left_A2 velocity" in printed(table.render(), 120)
    assert "left_A2 velocity" not in printed(table.render(), 120)


class Terminal:
    """A terminal, and what has come out of it, which a thread reads."""

    def __init__(self) -> None:
        self._reads, writes = pty.openpty()
        self.file, self.text = open(writes, "w", encoding="utf-8"), ""  # noqa: SIM115
        threading.Thread(target=self._read, daemon=True).start()

    def wait_for(self, expected: str) -> None:
        end = time.monotonic() + 60.0  # a machine may be slow
        while expected not in self.text:
            assert time.monotonic() < end, f"{expected!r} did not come; {self.text!r} did"
            time.sleep(0.01)

    def _read(self) -> None:
        with suppress(OSError):  # when the test is over
            while data := os.read(self._reads, 4096):
                self.text += data.decode(errors="replace")


def test_it_is_drawn_again_and_again_below_what_is_printed_and_wiped_away_at_the_end(
    monkeypatch: pytest.MonkeyPatch, robot: Robot
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    table, terminal = LiveTable("demo", JOINTS, BindingSettings()), Terminal()
    with redirect_stderr(terminal.file):
        with table.shown(Console(stderr=True)):
            terminal.wait_for("starting")
            table(tick_at(robot, 4.0))
            terminal.wait_for("4.0 s")
            print("arms stopped", file=sys.stderr)
            terminal.wait_for("arms stopped")
            before = len(terminal.text)
            table(replace(tick_at(robot, 5.0), states={}))
            terminal.wait_for("no live table: KeyError")
        assert sys.stderr is terminal.file
        print("the end", file=sys.stderr, flush=True)
        terminal.wait_for("the end")
    assert "\x1b[2K" in terminal.text[before:], "lines are cleared"


FAST = ActiveLimit(LimitKind.VELOCITY, ("left_A2",))
AT_LIMIT = ActiveLimit(LimitKind.POSITION, ("left_A4",))
NEAR_TABLE = ActiveLimit(LimitKind.SEPARATION, ("left_hand_0", "table_0"))
NEAR_ARM = ActiveLimit(LimitKind.SEPARATION, ("left_link_5_0", "right_link_5_0"))
OTHER_ARM = ActiveLimit(LimitKind.SEPARATION, ("right_link_1_0", "right_link_5_0"))


def words(tick: Tick, *binding: ActiveLimit, last: Event | None = None) -> str:
    return why(tick, "left", JOINTS["left"], binding, last)


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
def test_an_arm_that_is_away_from_its_target_is_held_by_what_is_at_work_on_it(
    robot: Robot, binding: tuple[ActiveLimit, ...], expected: str
) -> None:
    assert words(tick_at(robot, 1.0), *binding) == expected


def test_an_arm_that_is_at_its_target_follows_whatever_is_at_work(robot: Robot) -> None:
    tick = tick_at(robot, 1.0)
    targets = {arm: ArmTarget(pose, 1.0) for arm, pose in tick.tools.items()}
    assert words(replace(tick, targets=targets), FAST) == "follows the hand"


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
    chord = Event(0.5, "left", "engaged", "aligning", Reason(ReasonKind.ALIGNMENT_CHORD))
    assert words(aligning, last=chord) == "aligning"
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
