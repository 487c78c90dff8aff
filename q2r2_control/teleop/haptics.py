"""Short vibrations that tell a hand about its arm: what they are, and when."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from q2r2_control.config.teleop import HapticSettings
from q2r2_control.events import Event, ReasonKind
from q2r2_control.teleop.arm_states import ArmState, is_fault
from q2r2_control.types import HapticFeedback


class Pulse(NamedTuple):
    """One vibration."""

    frequency: float  # 0..1
    amplitude: float  # 0..1
    duration: float  # [s]


class Word(NamedTuple):
    """What a vibration tells."""

    meaning: str
    pulse: Pulse
    strongest: float | None = None  # amplitude that it grows to


ENGAGED = Pulse(0.5, 0.4, 0.08)
PAUSED = Pulse(0.3, 0.3, 0.08)
FAULT = Pulse(1.0, 1.0, 0.3)
SLIP = Pulse(0.2, 0.2, 0.05)
LIMIT = Pulse(0.8, 0.25, 0.05)
NEAR = Pulse(0.6, 0.1, 0.04)
CONTACT = Pulse(0.1, 0.2, 0.06)
GRASP = Pulse(0.7, 0.5, 0.12)
HOMING = Pulse(0.4, 0.55, 0.2)
STOPPED = Pulse(0.9, 0.9, 0.25)
EPISODE_BEGINS, EPISODE_ENDS = Pulse(0.6, 0.45, 0.15), Pulse(0.35, 0.35, 0.15)
EPISODE_DISCARDED = Pulse(0.2, 0.65, 0.25)
EPISODE_KEPT, EPISODE_REJECTED = Pulse(0.75, 0.42, 0.4), Pulse(0.15, 0.7, 0.5)
_NEAREST, _HARDEST = 0.6, 0.8  # amplitudes that NEAR and CONTACT grow to
# The weakest first: where two are due at once, the stronger one is felt. The docs' table is this one.
VOCABULARY = (
    Word("another 5 mm nearer to what the arm has to keep away from, from 50 mm to spare on", NEAR, _NEAREST),
    Word("the target has slipped along by another 20 mm or 0.1 rad", SLIP),
    Word("the tool's contact force has grown by another 5 N", CONTACT, _HARDEST),
    Word("a joint has come to its position limit", LIMIT),
    Word("paused, by its control or the alignment chord; home, or interrupted on the way", PAUSED),
    Word("an episode of the recording ends, or succeeded", EPISODE_ENDS),
    Word("engaged; both arms carry", ENGAGED),
    Word("the verdict on an episode: keep", EPISODE_KEPT),
    Word("an episode of the recording begins; a mark", EPISODE_BEGINS),
    Word("the gripper has closed on something", GRASP),
    Word("on the way home", HOMING),
    Word("an episode is discarded, or failed", EPISODE_DISCARDED),
    Word("the verdict on an episode: discard", EPISODE_REJECTED),
    Word("stopped, by the control that stops", STOPPED),
    Word("lost: stopped by a fault (lost data, a jump, a stop), or a press that was refused", FAULT),
)

_BEGINS = {
    ArmState.ENGAGED: ENGAGED,
    ArmState.CARRIED: ENGAGED,
    ArmState.HOMING: HOMING,
    ArmState.STOPPED: STOPPED,
}
_WHILE_STATE_STAYS = {
    ReasonKind.CARRY_BEGAN: ENGAGED,
    ReasonKind.EPISODE_BEGINS: EPISODE_BEGINS,
    ReasonKind.MARK: EPISODE_BEGINS,
    ReasonKind.EPISODE_ENDS: EPISODE_ENDS,
    ReasonKind.EPISODE_SUCCEEDED: EPISODE_ENDS,
    ReasonKind.EPISODE_FAILED: EPISODE_DISCARDED,
    ReasonKind.EPISODE_DISCARDED: EPISODE_DISCARDED,
}

_SLIP_STEP = 0.02  # the target slips by this between two pulses [m]
_SLIP_ANGLE_STEP = 0.1  # or by this [rad]
_NEAR_STEP, _NEAR_FROM = 0.005, 0.05  # [m]
_FORCE_STEP, _FORCE_TO = 5.0, 50.0  # [N]
_PAUSE = 0.05  # between two vibrations, so that they are felt as two [s]


class ArmCondition(NamedTuple):
    """What of an arm's surroundings and joints its hand feels."""

    spare: float  # how much nearer it may come to what it has to keep away from; inf: nothing is there [m]
    limits: frozenset[str]  # joints at a position limit
    force: float | None  # contact force at the tool, None: not measured [N]


class HapticPulses:
    """Vibrations of one arm's hand: see :data:`VOCABULARY`. What lasts is told once for each step that it grows by.

    The app vibrates until the next message, so the end of a pulse is a message as well.
    """

    def __init__(self, settings: HapticSettings | None = None) -> None:
        self.strength = (settings or HapticSettings()).strength  # of all vibrations, 0: none
        self._ends: float | None = None
        self._next = 0.0  # no vibration begins before [s]
        self._amplitude, self._felt_by = 0.0, ""
        self._slipped = _Steps(_SLIP_STEP), _Steps(_SLIP_ANGLE_STEP)
        self._nearness, self._force = _Steps(_NEAR_STEP), _Steps(_FORCE_STEP)
        self._limits: frozenset[str] = frozenset()
        self._grasps = False
        self._waiting: Pulse | None = None

    def tell(self, event: Event) -> None:
        """Start the pulse for a change of the arm's state; that of a refused press is that of a fault."""
        if is_fault(event):
            self._want(FAULT)
        elif event.source == event.destination:
            if (pulse := _WHILE_STATE_STAYS.get(event.kind)) is not None:
                self._want(pulse)
            elif event.kind is ReasonKind.VERDICT and (keep := event.reason.detail["keep"]) is not None:
                self._want(EPISODE_KEPT if keep else EPISODE_REJECTED)
        elif event.destination in _BEGINS:
            self._want(_BEGINS[ArmState(event.destination)])
        elif event.source in (ArmState.ENGAGED, ArmState.CARRIED, ArmState.HOMING):
            self._want(PAUSED)

    def slip(self, slip: float, slip_angle: float) -> None:
        """How far the target has slipped since engaging [m, rad]."""
        position, rotation = self._slipped
        if position.grew(slip) | rotation.grew(slip_angle):  # both count
            self._want(SLIP)

    def notice(self, condition: ArmCondition) -> None:
        """All of the next three."""
        self.near(condition.spare)
        self.limits(condition.limits)
        if condition.force is not None:
            self.contact(condition.force)

    def near(self, spare: float) -> None:
        """How much nearer the arm may come to what it has to keep away from [m]."""
        nearness = max(_NEAR_FROM - spare, 0.0)
        if self._nearness.grew(nearness):
            self._want(_grown(NEAR, _NEAREST, nearness / _NEAR_FROM))

    def contact(self, force: float) -> None:
        """The contact force at the tool [N]."""
        if self._force.grew(force):
            self._want(_grown(CONTACT, _HARDEST, force / _FORCE_TO))

    def limits(self, joints: Iterable[str]) -> None:
        """The joints of the arm that are at a position limit."""
        held = frozenset(joints)
        if held - self._limits:
            self._want(LIMIT)
        self._limits = held

    def grasps(self, holds: bool) -> None:
        """Whether the gripper is closed on something."""
        if holds and not self._grasps:
            self._want(GRASP)
        self._grasps = holds

    @property
    def idle(self) -> bool:
        """Whether nothing vibrates and nothing waits, so that :meth:`at` has nothing to send."""
        return self._ends is None and self._waiting is None

    def at(self, now: float, hand: str) -> HapticFeedback | None:
        """What to send to ``hand``, which drives the arm at ``now`` [s], or None."""
        if self._ends is not None and now >= self._ends:
            self._ends, self._next = None, now + _PAUSE
            return HapticFeedback(self._felt_by, 0.0, 0.0)  # which may not drive the arm any more
        pulse = self._waiting
        if pulse is None or (self._ends is None and now < self._next and pulse is not FAULT):
            return None
        self._waiting = None
        if self._ends is not None and pulse.amplitude < self._amplitude:
            return None
        self._ends, self._amplitude, self._felt_by = now + pulse.duration, pulse.amplitude, hand
        return HapticFeedback(hand, pulse.frequency, pulse.amplitude * self.strength)

    def _want(self, pulse: Pulse) -> None:
        if self.strength > 0.0 and (self._waiting is None or pulse.amplitude >= self._waiting.amplitude):
            self._waiting = pulse


class _Steps:
    """Counts steps that a quantity has grown by; it may shrink by two before they count anew."""

    def __init__(self, step: float) -> None:
        self._step, self._counted = step, 0

    def grew(self, value: float) -> bool:
        """Whether ``value`` is a step beyond what was counted; one that is no number is not."""
        if not math.isfinite(value):
            return False
        steps = int(value / self._step + 1e-9)
        if steps > self._counted:
            self._counted = steps
            return True
        if value <= max((self._counted - 2) * self._step, 0.0):
            self._counted = steps
        return False


def _grown(pulse: Pulse, strongest: float, share: float) -> Pulse:
    return pulse._replace(amplitude=pulse.amplitude + (strongest - pulse.amplitude) * min(share, 1.0))
