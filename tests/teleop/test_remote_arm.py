"""Two programs with one arm each that carry together: what they agree on, what each takes, and what ends it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.teleop.arm_states import is_refusal
from q2r2_control.teleop.remote_arm import CarriedPose, RemoteArm
from q2r2_control.types import SIDES, ArmTarget, Event
from tests.teleop.hands import PAUSED, Squeezing, operator, sidewards

BINDINGS = {"grip": "carry", "stick_left": "stop"}
CARRYING = {"left": "engaged", "right": "carried"}
TIMEOUT = 0.15  # [s]
LATE = 5  # ticks until what one program sends reaches the other


@dataclass
class Apart:
    """One operator whose arms are driven by two programs, which hear each other some ticks late."""

    changes: dict[str, Any] = field(default_factory=dict)
    silent: set[str] = field(default_factory=set)  # programs that nothing comes from
    spoil: Callable[[CarriedPose], CarriedPose] = lambda sent: sent  # what the left one sends

    def __post_init__(self) -> None:
        settings = operator(bindings=BINDINGS, **self.changes).settings
        self.programs = {arm: Squeezing(settings, (arm,)) for arm in SIDES}
        self.remotes = {arm: RemoteArm(other(arm), settings, f"{arm} 1", TIMEOUT) for arm in SIDES}
        for arm, program in self.programs.items():
            program.teleop.pair_with(self.remotes[arm])
        self.under_way: list[dict[str, tuple[Any, CarriedPose | None]]] = []
        self.ticks = 0

    def tick(self) -> dict[str, ArmTarget]:
        self.ticks += 1
        said: dict[str, tuple[Any, CarriedPose | None]] = {}
        for arm, program in self.programs.items():
            self.hear(arm)
            program.tick()
            remote = self.remotes[arm]
            sent = None
            if remote.sends is not None and remote.said is not None:
                sent = CarriedPose(remote.said.session, self.ticks, remote.sends, remote.reference)
                sent = self.spoil(sent) if arm == "left" else sent
            said[arm] = remote.said, sent
        self.under_way.append(said)
        return {arm: program.targets[arm] for arm, program in self.programs.items()}

    def hear(self, arm: str) -> None:
        remote, source = self.remotes[arm], other(arm)
        remote.other_run = f"{source} 1"
        if source not in self.silent and len(self.under_way) >= LATE:
            remote.heard, sent = self.under_way[-LATE][source]
            if sent is not None:
                remote.receive(sent, self.programs[arm].now)

    def run(self, duration: float, move: Callable[[float], pin.SE3] | None = None) -> list[dict[str, ArmTarget]]:
        """``move``: the pose of the left hand by the time since the call."""
        history = []
        for tick in range(round(duration / 0.001)):
            if move is not None:
                self.programs["left"].hands["left"] = move(0.001 * tick)
            history.append(self.tick())
        return history

    def push(self, hand: str, control: str) -> None:
        program = self.programs[hand]
        program.only, program.held = hand, {control: 1.0}
        self.run(0.1)
        program.held = {}
        self.run(0.1)

    def press(self, *hands: str) -> None:
        for pressed in (set(hands), set()):
            for arm, program in self.programs.items():
                program.lower = pressed & {arm}
            self.run(0.15)

    @property
    def states(self) -> dict[str, str]:
        return {arm: program.states[arm] for arm, program in self.programs.items()}

    @property
    def events(self) -> list[Event]:
        return [event for program in self.programs.values() for event in program.events]

    @property
    def refusals(self) -> list[str]:
        return [event.reason for event in self.events if is_refusal(event)]


def other(arm: str) -> str:
    return SIDES[1 - SIDES.index(arm)]


def carrying(*hands: str, **changes: Any) -> Apart:
    """The left hand carries, after ``hands`` were engaged."""
    apart = Apart(changes)
    apart.run(0.05)
    apart.press(*(hands or SIDES))
    apart.push("left", "grip")
    assert apart.states == CARRYING
    return apart


def going(apart: Apart) -> Callable[[float], pin.SE3]:
    """The left hand goes along and turns."""
    start = apart.programs["left"].hands["left"]
    way, turn = np.array([0.1, 0.05, -0.05]), np.array([0.0, 0.1, 0.4])
    return lambda t: pin.SE3(pin.exp3(t * turn) @ start.rotation, start.translation + t * way)


def assert_nothing_moves(apart: Apart) -> None:
    for targets in apart.run(0.3, going(apart)):
        assert {arm: target.pose for arm, target in targets.items()} == dict.fromkeys(SIDES)


def test_one_hand_moves_both_tools_and_their_targets_keep_their_relation() -> None:
    apart = carrying()
    start = apart.tick()
    wanted = start["left"].pose.actInv(start["right"].pose)  # type: ignore[union-attr]
    leading = apart.run(1.0, going(apart))
    for made, followed in zip(leading[:-LATE], leading[LATE:], strict=True):
        left, right = made["left"].pose, followed["right"].pose
        assert left is not None
        assert right is not None
        assert left.actInv(right).isApprox(wanted, 1e-9)
    way = leading[-1]["right"].pose.translation - start["right"].pose.translation  # type: ignore[union-attr]
    assert np.linalg.norm(way) > 0.08


@pytest.mark.parametrize("engaged", [("left",), SIDES])
def test_no_target_jumps_when_it_begins(engaged: tuple[str, ...]) -> None:
    apart = Apart()
    apart.run(0.05)
    apart.press(*engaged)
    history = apart.run(0.3, going(apart))
    apart.programs["left"].only, apart.programs["left"].held = "left", {"grip": 1.0}
    move = going(apart)
    history += apart.run(0.5, move)
    assert apart.states == CARRYING
    for before, after in pairwise(history):
        for arm in SIDES:
            if (a := before[arm].pose) is not None and (b := after[arm].pose) is not None:
                assert np.linalg.norm(b.translation - a.translation) < 0.002
    first = next(targets["right"].pose for targets in history if targets["right"].pose is not None)
    assert np.linalg.norm(first.translation - apart.programs["right"].tools["right"].translation) < 1e-9


def test_tools_that_lag_each_in_its_own_way_keep_their_relation() -> None:
    """The right arm follows 40 ms later than the left one; what the controller says of both comes late."""
    apart = carrying()
    for program in apart.programs.values():
        program.commanded = {}
    targets = [apart.tick()]
    wanted = targets[0]["left"].pose.actInv(targets[0]["right"].pose)  # type: ignore[union-attr]
    move, relations = going(apart), []
    for tick in range(2000):
        apart.programs["left"].hands["left"] = move(0.001 * tick)
        tools = {"left": targets[max(tick - 20, 0)]["left"].pose, "right": targets[max(tick - 60, 0)]["right"].pose}
        for arm in SIDES:
            apart.programs[arm].commanded = {arm: tools[arm]}
            apart.remotes[arm].reference = tick
        relations.append(tools["left"].actInv(tools["right"]))  # type: ignore[union-attr]
        targets.append(apart.tick())
    errors = [np.linalg.norm(relation.translation - wanted.translation) for relation in relations]
    assert max(errors[1000:]) < 1e-3 < max(errors[:400])


def test_the_arm_that_is_carried_needs_no_hand() -> None:
    apart = carrying("left")
    apart.programs["right"].silent = {"right"}
    assert apart.run(1.0, going(apart))[-1]["right"].pose is not None
    assert apart.states == CARRYING


def test_an_arm_that_sags_is_carried_from_where_it_is_commanded() -> None:
    apart = Apart()
    right = apart.programs["right"]
    hung = right.tools["right"]
    right.commanded = {"right": pin.SE3(hung.rotation, hung.translation + np.array([0.0, 0.0, 0.02]))}
    apart.run(0.05)
    apart.press("left")
    apart.push("left", "grip")
    assert apart.states == CARRYING
    command = right.targets["right"].command
    assert command is not None
    assert command.isApprox(right.commanded["right"], 1e-6)


class TestItEnds:
    @pytest.mark.parametrize("hand", SIDES)
    @pytest.mark.parametrize("by", ["grip", "pause"])
    def test_for_both_arms_by_a_press_of_either_hand(self, hand: str, by: str) -> None:
        apart = carrying()
        if by == "grip":
            apart.push(hand, by)
        else:
            apart.press(hand)
        assert apart.states == PAUSED
        assert_nothing_moves(apart)
        apart.press(*SIDES)
        assert apart.states == dict.fromkeys(SIDES, "engaged")

    @pytest.mark.parametrize("silent", SIDES)
    def test_for_both_arms_when_either_program_is_silent(self, silent: str) -> None:
        apart = carrying()
        moving = apart.run(0.3, going(apart))
        apart.silent = {silent}
        apart.run(TIMEOUT - 0.01)
        assert apart.states == CARRYING
        apart.run(0.02)
        assert apart.states[other(silent)] == "lost"
        apart.silent = set()
        apart.run(0.02)
        assert apart.states[silent] == "paused"
        assert moving[-1]["right"].pose is not None
        assert_nothing_moves(apart)

    @pytest.mark.parametrize("arm", SIDES)
    def test_for_both_arms_by_a_fault_of_one_that_is_not_linked(self, arm: str) -> None:
        apart = carrying(linked=False)
        apart.programs[arm].teleop.pause(apart.programs[arm].now, "the robot says so")
        apart.run(0.02)
        assert apart.states == {arm: "lost", other(arm): "paused"}
        assert_nothing_moves(apart)


Spoil = Callable[[CarriedPose], CarriedPose]
FAR = pin.SE3(np.eye(3), np.array([0.0, 0.06, 0.0]))
NEAR = pin.SE3(np.eye(3), np.array([0.0, 0.02, 0.0]))
TURNED = pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.3])), np.zeros(3))
HOSTILE: dict[str, Spoil] = {
    "it is not a number": lambda sent: sent._replace(pose=pin.SE3(sent.pose.rotation, np.full(3, np.nan))),
    "it is far away": lambda sent: sent._replace(pose=FAR * sent.pose),
    "it is turned": lambda sent: sent._replace(pose=sent.pose * TURNED),
    "it is of another session": lambda sent: sent._replace(session="left 1.99", pose=NEAR * sent.pose),
    "it is old": lambda sent: sent._replace(stamp=sent.stamp - 1000, pose=NEAR * sent.pose),
}


class TestATarget:
    @pytest.mark.parametrize("what", HOSTILE)
    def test_does_not_count_if(self, what: str) -> None:
        """One does nothing at all, and where no other comes, the arm stops where it is."""
        apart = carrying()
        apart.run(0.3, going(apart))
        before = apart.run(0.8)[-1]["right"].pose
        for spoilt in ([False] * 9 + [True]) * 10:
            apart.spoil = HOSTILE[what] if spoilt else lambda sent: sent
            assert_same(apart.tick()["right"].pose, before)
        assert apart.states == CARRYING
        apart.spoil = HOSTILE[what]
        for _ in range(round(1000 * TIMEOUT) + 2 * LATE):
            pose = apart.tick()["right"].pose
            assert pose is None or pose.isApprox(before, 1e-3)
        assert apart.states["right"] == "lost"
        reason = apart.programs["right"].events[-1].reason
        assert reason.startswith("no pose from the left arm's node for 0.15")

    @pytest.mark.parametrize("bound", ["leash", "box", "speed"])
    def test_that_goes_away_steadily_is_held_by_the_arms_own(self, bound: str) -> None:
        box = {"x": [0.3, 0.9], "y": [-0.55, 0.7], "z": [0.1, 0.8]}
        changes: dict[str, dict[str, Any]] = {
            "box": {"workspace": {"right": box}},
            "speed": {"speed_limit": {"right": {"linear": 0.1}}},
        }
        apart = carrying(**changes.get(bound, {}))
        held = apart.tick()["right"].pose
        assert held is not None
        if bound == "leash":
            apart.programs["right"].commanded = {"right": held}  # which is stuck
        begun = apart.ticks

        def going_away(sent: CarriedPose) -> CarriedPose:
            way = sidewards(1e-3 * (apart.ticks - begun))
            return sent._replace(pose=pin.SE3(sent.pose.rotation, held.translation - way))

        apart.spoil = going_away
        history = [apart.tick()["right"].pose for _ in range(500)]
        assert apart.states == CARRYING
        ways = [np.linalg.norm(pose.translation - held.translation) for pose in history]  # type: ignore[union-attr]
        most = {"leash": 0.1, "box": 0.15, "speed": 0.05}[bound]
        assert most - 0.002 < ways[-1] < most + 1e-3
        assert max(np.abs(np.diff(ways))) < (1.01e-4 if bound == "speed" else 1.01e-3)


def assert_same(pose: pin.SE3 | None, before: pin.SE3 | None) -> None:
    """As of a hand that rests."""
    assert pose is not None
    assert before is not None
    assert pose.isApprox(before, 1e-3)


class TestItDoesNotBegin:
    def ask(self, apart: Apart, *engaged: str) -> list[str]:
        apart.run(0.05)
        if engaged:
            apart.press(*engaged)
        apart.push("left", "grip")
        apart.run(TIMEOUT)
        assert "carried" not in apart.states.values()
        return apart.refusals

    def test_for_an_arm_that_is_not_engaged(self) -> None:
        assert self.ask(Apart(), "right") == ["not carried: engage the arm first"]

    def test_with_a_program_that_does_not_answer_or_says_no(self) -> None:
        apart = Apart(silent={"right"})
        assert self.ask(apart, "left") == ["not carried: the right arm's node does not answer"]
        apart = Apart()
        apart.remotes["right"].problem = "two publishers"
        assert self.ask(apart, "left") == ["not carried: two publishers"]

    def test_where_both_hands_ask_at_once(self) -> None:
        apart = Apart()
        apart.run(0.05)
        apart.press(*SIDES)
        for arm, program in apart.programs.items():
            program.only, program.held = arm, {"grip": 1.0}
        apart.run(0.3)
        assert apart.states == dict.fromkeys(SIDES, "engaged")
        assert apart.refusals == ["not carried: both hands ask"] * 2

    def test_by_the_answer_to_an_earlier_ask(self) -> None:
        apart = carrying()
        remote, now = apart.remotes["left"], apart.programs["left"].now
        assert isinstance(remote.answer(now), pin.SE3)
        remote.end("grip")
        assert remote.ask(now) is None
        assert remote.answer(now) is None

    def test_again_by_itself_after_a_program_was_restarted(self) -> None:
        apart = carrying()
        word = apart.remotes["left"].said
        assert word is not None
        apart.remotes["right"].heard = replace(word, session="left 1.2", to="right of before")
        assert not apart.remotes["right"].asked
        apart.remotes["right"].heard = replace(word, session="left 1.2")
        assert apart.remotes["right"].asked
