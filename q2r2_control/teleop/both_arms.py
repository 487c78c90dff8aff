"""Carry out the actions for both arms: stop, motion home, carrying, recording. Either hand may ask for them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import pinocchio as pin

from q2r2_control.config.bindings import Action, Gesture
from q2r2_control.config.recording import subtask_name
from q2r2_control.config.teleop import Stance, TeleopSettings
from q2r2_control.events import CommonReason, Reason, ReasonKind
from q2r2_control.quaternions import floats_of, se3_of
from q2r2_control.teleop.arm import ArmTeleop, pressed
from q2r2_control.teleop.arm_states import AT_REST, ArmState, Cause
from q2r2_control.teleop.carry import CarriedTools, RelationKeeper
from q2r2_control.teleop.gestures import Press
from q2r2_control.teleop.hand_motion import Anchor, ArmMeasurements
from q2r2_control.teleop.reasons import TeleopReason

_OUTCOMES = {Action.RECORD_FAILURE: TeleopReason.EPISODE_FAILED, Action.RECORD_SUCCESS: TeleopReason.EPISODE_SUCCEEDED}


class EpisodeMarks:
    """Turns the presses that mark episodes into events. Like all events, these events are recorded.

    An episode begins with its first subtask. If no episode begins in a run, the whole run is one episode.
    """

    actions = (
        *(Action.RECORD_DISCARD, *_OUTCOMES, Action.RECORD_TOGGLE, Action.RECORD_MARK),
        Action.NEXT_SUBTASK,
    )

    def __init__(self) -> None:
        self.recorded = False  # Whether the run is recorded.
        self.open = False  # Whether an episode has begun and not ended.
        self.any = False  # Whether there is an episode that could be discarded.
        self.begun = False  # Whether an episode has begun in this run. If not, the whole run is one episode.
        self.subtask = 1  # The number of the present subtask, from 1.
        self.subtasks: Sequence[str] = ()  # The names of all subtasks, in their order; empty if subtasks have no names.

    def apply(self, action: Action) -> Reason:
        """Apply an action that the operator asks for, and return the reason for the event.

        Success and failure end the episode.
        """
        if not self.recorded:
            return Reason(TeleopReason.NO_RECORDING)
        if action is Action.RECORD_MARK:
            return Reason(TeleopReason.MARK)
        if action is Action.NEXT_SUBTASK:
            return self._next_subtask()
        if action is Action.RECORD_DISCARD:
            self.open = False
            any_episode, self.any = self.any, False
            return Reason(TeleopReason.EPISODE_DISCARDED if any_episode else TeleopReason.NO_EPISODE)
        if action in _OUTCOMES:
            self.open = False
            return Reason(_OUTCOMES[action])
        kind = TeleopReason.EPISODE_ENDS if self.open else TeleopReason.EPISODE_BEGINS
        self.follow(kind)
        return Reason(kind)

    def _next_subtask(self) -> Reason:
        if self.begun and not self.open:
            return Reason(TeleopReason.NO_OPEN_EPISODE)
        if self.subtasks and self.subtask >= len(self.subtasks):
            return Reason.of(TeleopReason.LAST_SUBTASK, name=subtask_name(self.subtasks, self.subtask))
        self.subtask += 1
        name = subtask_name(self.subtasks, self.subtask)
        return Reason.of(TeleopReason.SUBTASK_BEGINS, number=self.subtask, name=name)

    def as_json(self) -> dict[str, Any]:
        """Return the state as data for ``json.dumps``."""
        return {
            "records": self.recorded,
            "episode_open": self.open,
            "any_episode": self.any,
            "episode_begun": self.begun,
            "subtask": self.subtask,
            "subtasks": list(self.subtasks),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take a state of :meth:`as_json`; raises KeyError for other data."""
        self.recorded, self.open, self.any = state["records"], state["episode_open"], state["any_episode"]
        self.begun, self.subtask, self.subtasks = state["episode_begun"], state["subtask"], state["subtasks"]

    def follow(self, kind: ReasonKind) -> None:
        """Apply an event to the state. The event may come from another program, which has recorded it."""
        if kind in _OUTCOMES.values():
            self.open = False
        elif kind is TeleopReason.SUBTASK_BEGINS:
            self.subtask += 1
        elif kind in (TeleopReason.EPISODE_BEGINS, TeleopReason.EPISODE_ENDS, TeleopReason.EPISODE_DISCARDED):
            self.open, self.any = kind is TeleopReason.EPISODE_BEGINS, kind is not TeleopReason.EPISODE_DISCARDED
            self.begun = True
            if self.open:
                self.subtask = 1


_Poses = Mapping[str, pin.SE3]


class CarryMode:
    """The mode in which one hand moves both tools, which hold one object.

    Both arms stop together, so that neither pulls at the object.

    ``leader`` is the arm whose hand moves both tools. The follower is the other arm.
    """

    def __init__(self, leader: ArmTeleop, follower: ArmTeleop, tools: _Poses, now: float) -> None:
        """Begin to carry at time ``now`` [s]. ``tools`` are the tool poses by arm (world frame)."""
        self.leader, self._follower = leader, follower
        self._tools = CarriedTools(tools)
        self._keeper = RelationKeeper()
        self._box = follower.motion.workspace()
        follower.change(Cause.CARRY, now, Reason.of(TeleopReason.CARRIED_BY, arm=leader.arm))
        leader.motion.carry(self._tools, follower.arm, self._box, now)
        leader.record_event(now, Reason(TeleopReason.CARRY_BEGAN))

    @property
    def lasts(self) -> bool:
        return self.leader.state is ArmState.ENGAGED and self._follower.state is ArmState.CARRIED

    def end(self, now: float, reason: Reason) -> None:
        """Let both arms hold."""
        for arm in (self.leader, self._follower):
            arm.change(Cause.CARRY_ENDS, now, reason)

    def targets(self, now: float, expected: _Poses, at_once: _Poses) -> dict[str, pin.SE3]:
        """Return the targets of both arms. All poses are in the world frame.

        Args:
            now: The time [s].
            expected: The tool poses at the controller's reference, by arm.
            at_once: The same poses if both belong to one moment; otherwise empty.
        """
        tools, leader, follower = self._tools, self.leader.arm, self._follower.arm
        slowest = tools.slowest(tools.frames_of(expected))
        tools.frame = frame = se3_of(self.leader.target(now, None if slowest is None else floats_of(slowest)))
        targets = tools.at(frame)
        if len(frames := tools.frames_of(at_once)) == len(targets):
            self._keeper.update_shift(frames[leader], frames[follower], now)
        position, rotation = floats_of(tools.tool_at(follower, self._keeper.frame(frame)))
        targets[follower] = se3_of((self._box.clip(position), rotation))
        return targets


class BothArms:
    """The arms of one operator, and the hands that drive them."""

    def __init__(self, settings: TeleopSettings, names: Iterable[str]) -> None:
        self.arms = {name: ArmTeleop(name, settings) for name in names}
        self.carry: CarryMode | None = None
        self.asks_home: str | None = None  # The arm whose hand asked to move home; None if no hand has asked.
        self.marks = EpisodeMarks()
        self.use(settings)
        self.assign_hands(settings.stance)

    def use(self, settings: TeleopSettings) -> None:
        self._bindings, self._leash = settings.bindings, settings.leash.carried()

    def assign_hands(self, stance: Stance) -> None:
        self.arm_of_hand = {stance.hand_of(name): name for name in self.arms}

    def any_in(self, *states: ArmState) -> bool:
        return any(arm.state in states for arm in self.arms.values())

    def all_in(self, states: Collection[ArmState]) -> bool:
        return all(arm.state in states for arm in self.arms.values())

    def change(self, cause: Cause, now: float, reason: Reason) -> None:
        """Change the state of every arm by ``cause``."""
        for arm in self.arms.values():
            arm.change(cause, now, reason)

    def act(self, around: ArmMeasurements, now: float) -> dict[str, list[Press]]:
        """Carry out the actions that concern both arms.

        Returns:
            For each arm, the presses that are left for this arm alone.
        """
        presses = {name: arm.take_presses(now) for name, arm in self.arms.items()}
        grips = any(arm.gripped or arm.chord for arm in self.arms.values())
        if not grips and not any(presses.values()):
            return presses
        for action in self.marks.actions:
            if (name := self._asked(presses, action)) is not None:
                self.arms[name].record_event(now, self.marks.apply(action))
        if self._asked(presses, Action.STOP) is not None:
            cause = Cause.GO_ON if self.all_in({ArmState.STOPPED}) else Cause.STOP
            self.change(cause, now, self._reason(Action.STOP))
        elif self.any_in(ArmState.STOPPED):
            for name, listed in presses.items():
                wanted = {self._bindings.action_of(*press) for press in listed if press.gesture is not Gesture.DOWN}
                if wanted - set(self.marks.actions):
                    self.arms[name].record_event(now, Reason(TeleopReason.NOT_ENGAGED, cause=self._stopped()))
        elif self.any_in(ArmState.HOMING):
            if grips or any(press.gesture is Gesture.DOWN for listed in presses.values() for press in listed):
                self.change(Cause.PRESS, now, Reason(CommonReason.HOMING_INTERRUPTED))
        elif (asked_by := self._asked(presses, Action.HOME)) is not None:
            self.home(now, asked_by, around.obstacles.get(asked_by))
        elif self.carry is not None and (reason := self._ends_carry(presses)) is not None:
            self.end_carry(now, reason)
        elif self.carry is None and (asked_by := self._asked(presses, Action.CARRY)) is not None:
            self._begin_carry(asked_by, around, now)
        else:
            return presses
        return {name: [] for name in self.arms}

    def home(self, now: float, asked_by: str | None, problem: Reason | None = None) -> None:
        """Let both arms go home, or record an event that says why they do not.

        Args:
            now: The time [s].
            asked_by: The arm whose hand asks to move home; None if a program asks.
            problem: Why the arms may not go home, if the caller knows a reason.
        """
        if self.any_in(ArmState.ALIGNING):
            problem = problem or Reason(TeleopReason.ALIGNING)
        if self.any_in(ArmState.STOPPED):
            problem = problem or self._stopped()
        if self.carry is not None:
            problem = problem or Reason(TeleopReason.CARRYING)
        if problem is None and asked_by is not None:
            problem = self.arms[asked_by].watchdog(now)
        self.asks_home = asked_by
        if problem is None:
            self.change(Cause.HOME, now, Reason(CommonReason.HOMING) if asked_by is None else self._reason(Action.HOME))
            return
        for arm in self.arms.values():
            arm.record_event(now, Reason(TeleopReason.NOT_HOMING, cause=problem))

    def end_carry(self, now: float, reason: Reason) -> None:
        """End carrying, if two arms carry. Afterwards both arms hold."""
        if self.carry is not None:
            self.carry.end(now, reason)
        self.carry = None

    def _take_up(self, arm: ArmTeleop, around: ArmMeasurements) -> Anchor | Reason:
        """Return the tool pose at which ``arm`` begins to carry, or the reason why it may not carry."""
        if arm.state is not ArmState.ENGAGED:
            if arm.state not in AT_REST:
                return Reason.of(TeleopReason.OTHER_ARM_BUSY, state=str(arm.state))
            return around.obstacles.get(arm.arm) or around.anchor(arm.arm) or Reason(TeleopReason.TOOL_UNKNOWN)
        if around.lag(arm.arm, arm.offset) >= (self._leash.distance or math.inf):
            return Reason(TeleopReason.TOOL_HELD_UP)
        target = around.targets.get(arm.arm)
        return Reason(TeleopReason.TOOL_UNKNOWN) if target is None else Anchor(target, arm.offset)

    def _begin_carry(self, name: str, around: ArmMeasurements, now: float) -> None:
        leader = self.arms[name]
        other = next((arm for arm in self.arms.values() if arm is not leader), None)
        taken = {arm.arm: self._take_up(arm, around) for arm in (leader, other) if arm is not None}
        problem = next((found for found in taken.values() if isinstance(found, Reason)), None)
        if leader.state is not ArmState.ENGAGED:
            problem = Reason(TeleopReason.ENGAGE_FIRST)
        elif other is None and problem is None:
            problem = Reason(TeleopReason.ONE_ARM)
        if problem is not None:
            leader.record_event(now, Reason(TeleopReason.NOT_CARRIED, cause=problem))
        elif other is not None:
            anchors = {arm: found for arm, found in taken.items() if isinstance(found, Anchor)}
            other.offset = anchors[other.arm].offset
            self.carry = CarryMode(leader, other, {arm: anchor.tool for arm, anchor in anchors.items()}, now)

    def _ends_carry(self, presses: Mapping[str, Sequence[Press]]) -> Reason | None:
        if any(arm.chord for arm in self.arms.values()):
            return Reason(TeleopReason.ALIGNMENT_CHORD)
        for control, gesture in (press for listed in presses.values() for press in listed):
            pauses = self._bindings.action_of(control, Gesture.TAP) is Action.PAUSE_TOGGLE
            if (pauses and gesture is Gesture.DOWN) or self._bindings.action_of(control, gesture) is Action.CARRY:
                return pressed(control)
        return None

    def _asked(self, presses: Mapping[str, Sequence[Press]], action: Action) -> str | None:
        """Return the arm whose hand asked for ``action``, or None."""
        for name, listed in presses.items():
            if any(self._bindings.action_of(*press) is action for press in listed):
                return name
        return None

    def _reason(self, action: Action) -> Reason:
        return Reason.of(TeleopReason.COMMANDED, action=str(action), control=self._bindings.words_of(action))

    def _stopped(self) -> Reason:
        return Reason.of(TeleopReason.STOPPED, control=self._bindings.words_of(Action.STOP))
