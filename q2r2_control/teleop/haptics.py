"""Short vibrations that tell a hand about its arm."""

from __future__ import annotations

import math
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
    meaning: str
    strongest: float | None = None  # amplitude that it grows to

    def grown(self, share: float) -> Pulse:
        """The same at a share of the way to its strongest."""
        most = self.amplitude if self.strongest is None else self.strongest
        return self._replace(amplitude=self.amplitude + (most - self.amplitude) * min(share, 1.0))


NEAR = Pulse(0.6, 0.1, 0.04, "another 5 mm nearer to what the arm has to keep away from, from 50 mm to spare on", 0.6)
SLIP = Pulse(0.2, 0.2, 0.05, "the target has slipped along by another 20 mm or 0.1 rad")
CONTACT = Pulse(0.1, 0.2, 0.06, "the tool's contact force has grown by another 5 N", 0.8)
LIMIT = Pulse(0.8, 0.25, 0.05, "a joint has come to its position limit")
PAUSED = Pulse(0.3, 0.3, 0.08, "paused, by its control or the alignment chord; home, or interrupted on the way")
EPISODE_ENDS = Pulse(0.35, 0.35, 0.15, "an episode of the recording ends, or succeeded")
ENGAGED = Pulse(0.5, 0.4, 0.08, "engaged; both arms carry")
EPISODE_KEPT = Pulse(0.75, 0.42, 0.4, "the verdict on an episode: keep")
EPISODE_BEGINS = Pulse(0.6, 0.45, 0.15, "an episode of the recording begins; a mark")
GRASP = Pulse(0.7, 0.5, 0.12, "the gripper has closed on something")
HOMING = Pulse(0.4, 0.55, 0.2, "on the way home")
EPISODE_DISCARDED = Pulse(0.2, 0.65, 0.25, "an episode is discarded, or failed")
EPISODE_REJECTED = Pulse(0.15, 0.7, 0.5, "the verdict on an episode: discard")
STOPPED = Pulse(0.9, 0.9, 0.25, "stopped, by the control that stops")
FAULT = Pulse(1.0, 1.0, 0.3, "lost: stopped by a fault (lost data, a jump, a stop), or a press that was refused")
# The weakest first: where two are due at once, the stronger one is felt. The docs' table is this one.
VOCABULARY = (
    *(NEAR, SLIP, CONTACT, LIMIT, PAUSED, EPISODE_ENDS, ENGAGED, EPISODE_KEPT, EPISODE_BEGINS, GRASP, HOMING),
    *(EPISODE_DISCARDED, EPISODE_REJECTED, STOPPED, FAULT),
)

_BEGINS: dict[str, Pulse] = {
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
    """Surroundings and joints of an arm, which its hand feels."""

    spare: float  # how much nearer it may come to what it has to keep away from; inf: nothing is there [m]
    limits: frozenset[str]  # joints at a position limit
    force: float | None  # contact force at the tool, None: not measured [N]


class HapticPulses:
    """Vibrations of one arm's hand, see :data:`VOCABULARY`; the end of each is a message, since the app goes on."""

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

    def start_pulse(self, event: Event) -> None:
        """Start the pulse for an event of the arm."""
        if is_fault(event):
            self._want(FAULT)
        elif event.source == event.destination:
            if (pulse := _WHILE_STATE_STAYS.get(event.kind)) is not None:
                self._want(pulse)
            elif event.kind is ReasonKind.VERDICT and (keep := event.reason.detail["keep"]) is not None:
                self._want(EPISODE_KEPT if keep else EPISODE_REJECTED)
        elif event.destination in _BEGINS:
            self._want(_BEGINS[event.destination])
        elif event.source in (ArmState.ENGAGED, ArmState.CARRIED, ArmState.HOMING):
            self._want(PAUSED)

    def slip(self, slip: float, slip_angle: float) -> None:
        """How far the target has slipped since engaging [m, rad]."""
        position, rotation = self._slipped
        if position.grew(slip) | rotation.grew(slip_angle):  # both count
            self._want(SLIP)

    def notice(self, condition: ArmCondition) -> None:
        """The arm comes near to something, touches it, or is limited by a joint."""
        nearness = max(_NEAR_FROM - condition.spare, 0.0)
        if self._nearness.grew(nearness):
            self._want(NEAR.grown(nearness / _NEAR_FROM))
        if condition.limits - self._limits:
            self._want(LIMIT)
        self._limits = condition.limits
        if condition.force is not None and self._force.grew(condition.force):
            self._want(CONTACT.grown(condition.force / _FORCE_TO))

    def grasps(self, holds: bool) -> None:
        """Whether the gripper is closed on something."""
        if holds and not self._grasps:
            self._want(GRASP)
        self._grasps = holds

    def at(self, now: float, hand: str) -> HapticFeedback | None:
        """The vibration for ``hand``, which drives the arm at ``now`` [s], or None."""
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
        if not math.isfinite(value):
            return False
        steps = int(value / self._step + 1e-9)
        if steps > self._counted:
            self._counted = steps
            return True
        if value <= max((self._counted - 2) * self._step, 0.0):
            self._counted = steps
        return False
