"""What is for both arms, whichever hand asks for it: the stop, the way home, swapped hands, carrying, the recording."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from q2r2_control.config.bindings import Action, Gesture
from q2r2_control.config.teleop import Stance, TeleopSettings
from q2r2_control.teleop.arm import ArmTeleop
from q2r2_control.teleop.arm_states import AT_REST, ArmState, Cause
from q2r2_control.teleop.carry_mode import CarryMode
from q2r2_control.teleop.episode_marks import EpisodeMarks
from q2r2_control.teleop.gestures import Press


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What of the arms themselves counts in one tick; poses are in the world."""

    tools: Mapping[str, pin.SE3]  # measured
    targets: Mapping[str, pin.SE3]  # the last ones
    commanded: Mapping[str, pin.SE3] | None = None  # by the controller's reference
    obstacles: Mapping[str, str] = field(default_factory=dict)  # arm -> why it may not be engaged

    def anchor(self, arm: str) -> pin.SE3 | None:
        """The tool's pose for an anchor: measured position, commanded orientation. None: not known."""
        measured = self.tools.get(arm)
        if measured is None:
            return None
        reference = (self.commanded or self.targets).get(arm, measured)
        return pin.SE3(reference.rotation, measured.translation)

    def lag(self, arm: str) -> float:
        """From where the controller has a tool to its last target [m]."""
        if self.commanded is None or arm not in self.commanded or arm not in self.targets:
            return 0.0
        return float(np.linalg.norm(self.targets[arm].translation - self.commanded[arm].translation))


class BothArms:
    """The arms of one operator, and which hand drives which."""

    def __init__(self, settings: TeleopSettings, names: Iterable[str]) -> None:
        self.arms = {name: ArmTeleop(name, settings) for name in names}
        self.carry: CarryMode | None = None
        self.asks_home: str | None = None  # the arm whose hand asked for the way home; None: no hand did
        self.marks = EpisodeMarks()
        self.use(settings)
        self.assign_hands(settings.stance)

    def use(self, settings: TeleopSettings) -> None:
        """Go by these settings from now on."""
        self._bindings, self._leash = settings.bindings, settings.leash.carried()

    def assign_hands(self, stance: Stance) -> None:
        """Let the hands drive the arms as ``stance`` says."""
        same = stance is Stance.SIDE_BY_SIDE
        self.arm_of_hand = {name if same else _other(name): name for name in self.arms}

    def hand_of(self, name: str) -> str:
        """The hand that drives an arm."""
        return next(hand for hand, arm in self.arm_of_hand.items() if arm == name)

    def any_in(self, *states: ArmState) -> bool:
        """Whether an arm is in one of these states."""
        return any(arm.state in states for arm in self.arms.values())

    def all_in(self, states: Collection[ArmState]) -> bool:
        """Whether every arm is in one of these states."""
        return all(arm.state in states for arm in self.arms.values())

    def change(self, cause: Cause, now: float, reason: str) -> None:
        """Follow a cause that is for every arm."""
        for arm in self.arms.values():
            arm.change(cause, now, reason)

    def act(self, around: Surroundings, now: float) -> dict[str, list[Press]]:
        """Do what the hands ask for both arms; returns the presses that are left for each."""
        presses = {name: arm.take_presses(now) for name, arm in self.arms.items()}
        if not any(presses.values()) and not any(arm.grips or arm.chord for arm in self.arms.values()):
            return presses  # as at most ticks
        for action in self.marks.actions:
            if (name := self._asked(presses, action)) is not None:
                self.arms[name].tell(now, self.marks.take(action))
        if self._asked(presses, Action.STOP) is not None:
            cause = Cause.GO_ON if self.all_in({ArmState.STOPPED}) else Cause.STOP
            self.change(cause, now, self._reason(Action.STOP))
        elif self.any_in(ArmState.STOPPED):
            self._refuse_while_stopped(presses, now)
        elif self.any_in(ArmState.HOMING):
            begun = any(press.gesture is Gesture.DOWN for listed in presses.values() for press in listed)
            if begun or any(arm.grips or arm.chord for arm in self.arms.values()):
                self.change(Cause.PRESS, now, "the way home was interrupted")
        elif (asked_by := self._asked(presses, Action.HOME)) is not None:
            self.home(now, asked_by, around.obstacles)
        elif self.carry is not None and (reason := self._ends_carry(presses)) is not None:
            self.end_carry(now, reason)
        elif self.carry is None and (asked_by := self._asked(presses, Action.CARRY)) is not None:
            self._begin_carry(asked_by, around, now)
        else:
            return presses
        return {name: [] for name in self.arms}

    def home(self, now: float, asked_by: str | None, obstacles: Mapping[str, str]) -> None:
        """Both arms shall go home; the hand of the arm ``asked_by`` has to be there on the way, None: no hand.

        What is in the way is told as an event.
        """
        problem = next(iter(obstacles.values()), None)
        if self.any_in(ArmState.ALIGNING):
            problem = problem or "an alignment is not over"
        if self.any_in(ArmState.STOPPED):
            problem = problem or "stopped"
        if self.carry is not None:
            problem = problem or "two arms carry"
        if problem is None and asked_by is not None:
            problem = self.arms[asked_by].watchdog(now)
        self.asks_home = asked_by
        for arm in self.arms.values():
            if problem is not None:
                arm.tell(now, f"not homing: {problem}")
            else:
                arm.change(Cause.HOME, now, "way home" if asked_by is None else self._reason(Action.HOME))

    def swap_hands(self, presses: Mapping[str, Sequence[Press]], now: float) -> None:
        """If it is asked for, each hand drives the other arm, and has to be seen anew before it does."""
        if not any(presses.values()) or self._asked(presses, Action.SWAP_HANDS) is None:
            return
        alone = len(self.arms) < 2 and "not swapped: this program drives one arm only"
        busy = not self.all_in(AT_REST) and "not swapped: pause both arms first"
        if problem := alone or busy:
            for arm in self.arms.values():
                arm.tell(now, problem)
            return
        self.arm_of_hand = {_other(hand): name for hand, name in self.arm_of_hand.items()}
        for arm in self.arms.values():
            arm.forget()
            arm.tell(now, f"driven by the {self.hand_of(arm.arm)} hand")

    def end_carry(self, now: float, reason: str) -> None:
        """If two arms carry, both hold."""
        if self.carry is not None:
            self.carry.end(now, reason)
        self.carry = None

    def _begin_carry(self, name: str, around: Surroundings, now: float) -> None:
        """The hand of the arm ``name`` moves both tools."""
        leader = self.arms[name]
        other = next((arm for arm in self.arms.values() if arm is not leader), None)
        if other is None:
            leader.tell(now, "not carried: this program drives one arm only")
            return
        engaged = [arm for arm in (leader, other) if arm.state is ArmState.ENGAGED]
        asked = {
            arm.arm: around.targets.get(arm.arm) if arm in engaged else around.anchor(arm.arm)
            for arm in (leader, other)
        }
        tools = {arm: tool for arm, tool in asked.items() if tool is not None}
        problem = None
        if leader not in engaged:
            problem = "engage the arm first"
        elif other not in engaged and other.state not in AT_REST:
            problem = f"the other arm is {other.state}"
        elif other.arm in around.obstacles:
            problem = around.obstacles[other.arm]
        elif len(tools) < len(asked):
            problem = "a tool's pose is not known"
        elif any(around.lag(arm.arm) >= (self._leash.distance or np.inf) for arm in engaged):
            problem = "a tool is held up on the way to its target"
        if problem is not None:
            leader.tell(now, f"not carried: {problem}")
        else:
            self.carry = CarryMode(leader, other, tools, now)

    def _ends_carry(self, presses: Mapping[str, Sequence[Press]]) -> str | None:
        """What of this tick's controls ends it, or None."""
        if any(arm.chord for arm in self.arms.values()):
            return "alignment chord"
        for control, gesture in (press for listed in presses.values() for press in listed):
            pauses = self._bindings.action_of(control, Gesture.TAP) is Action.PAUSE_TOGGLE
            if (pauses and gesture is Gesture.DOWN) or self._bindings.action_of(control, gesture) is Action.CARRY:
                return control
        return None

    def _refuse_while_stopped(self, presses: Mapping[str, Sequence[Press]], now: float) -> None:
        wanted = {
            name: [self._bindings.action_of(*press) for press in listed if press.gesture is not Gesture.DOWN]
            for name, listed in presses.items()
        }
        for name, actions in wanted.items():
            if set(actions) - set(self.marks.actions):
                self.arms[name].tell(now, f"not engaged: stopped, {self._bindings.words_of(Action.STOP)} goes on")

    def _asked(self, presses: Mapping[str, Sequence[Press]], action: Action) -> str | None:
        """The arm whose hand asked for ``action``, or None."""
        for name, listed in presses.items():
            if any(self._bindings.action_of(*press) is action for press in listed):
                return name
        return None

    def _reason(self, action: Action) -> str:
        return f"{action} ({self._bindings.words_of(action)})"


def _other(side: str) -> str:
    return "right" if side == "left" else "left"
