"""Short vibrations that tell a hand about the state of its arm."""

from __future__ import annotations

import math
from typing import NamedTuple

from q2r2_control.config.teleop import HapticSettings
from q2r2_control.events import Event, ReasonKind
from q2r2_control.teleop.arm_states import ArmState, is_fault
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import HapticFeedback


class Pulse(NamedTuple):
    """One vibration."""

    frequency: float  # Relative frequency of the vibration, from 0 to 1.
    amplitude: float  # Relative amplitude, from 0 to 1.
    duration: float  # Duration of the vibration [s].
    meaning: str  # The event that the vibration reports, in words.
    strongest: float | None = None  # Greatest amplitude, if the amplitude grows with a quantity; otherwise None.

    def grown(self, share: float) -> Pulse:
        """Return the vibration with an amplitude that grows to :attr:`strongest` while ``share`` grows from 0 to 1."""
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
EPISODE_BEGINS = Pulse(0.6, 0.45, 0.15, "an episode of the recording begins, or a subtask of it; a mark")
GRASP = Pulse(0.7, 0.5, 0.12, "the gripper has closed on something")
HOMING = Pulse(0.4, 0.55, 0.2, "on the way home")
EPISODE_DISCARDED = Pulse(0.2, 0.65, 0.25, "an episode is discarded, or failed")
EPISODE_REJECTED = Pulse(0.15, 0.7, 0.5, "the verdict on an episode: discard")
STOPPED = Pulse(0.9, 0.9, 0.25, "stopped, by the control that stops")
FAULT = Pulse(1.0, 1.0, 0.3, "lost: stopped by a fault (lost data, a jump, a stop), or a press that was refused")
# The weakest vibration comes first. If two are due at the same time, the stronger one is felt. The docs show this
# table.
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
_WHILE_STATE_STAYS: dict[ReasonKind, Pulse] = {
    TeleopReason.CARRY_BEGAN: ENGAGED,
    TeleopReason.EPISODE_BEGINS: EPISODE_BEGINS,
    TeleopReason.MARK: EPISODE_BEGINS,
    TeleopReason.SUBTASK_BEGINS: EPISODE_BEGINS,
    TeleopReason.EPISODE_ENDS: EPISODE_ENDS,
    TeleopReason.EPISODE_SUCCEEDED: EPISODE_ENDS,
    TeleopReason.EPISODE_FAILED: EPISODE_DISCARDED,
    TeleopReason.EPISODE_DISCARDED: EPISODE_DISCARDED,
}

# Slip is the distance or the angle by which leash and workspace have held the target back.
_SLIP_STEP = 0.02  # Increase of the position's slip from one pulse to the next [m].
_SLIP_ANGLE_STEP = 0.1  # Increase of the rotation's slip from one pulse to the next [rad].
_NEAR_STEP, _NEAR_FROM = 0.005, 0.05  # Approach from one pulse to the next, and the distance at which pulses begin [m].
_FORCE_STEP, _FORCE_TO = 5.0, 50.0  # Increase of the force between two pulses; the force of the strongest pulse [N].
_PAUSE = 0.05  # Pause between two vibrations, so that the hand does not feel them as one [s].


class ArmCondition(NamedTuple):
    """What the hand feels of an arm: bodies near it, joints at their limits, and the contact force."""

    spare: float  # Distance by which the arm may still approach another body; infinite if no body is near [m].
    limits: frozenset[str]  # Names of the joints that are at a position limit.
    force: float | None  # Contact force at the tool; None if it is not measured [N].


class HapticPulses:
    """Computes the vibrations of the hand that drives one arm. See :data:`VOCABULARY`.

    A second message ends each vibration, because the headset's app vibrates until it is told to stop.
    """

    def __init__(self, settings: HapticSettings | None = None) -> None:
        self.strength = (settings or HapticSettings()).strength  # Factor of all amplitudes, from 0 to 1.
        self._ends: float | None = None  # Time at which the present vibration ends [s]; None if nothing vibrates.
        self._next = 0.0  # Earliest time of the next vibration [s].
        self._amplitude, self._felt_by = 0.0, ""
        self._slipped = _Steps(_SLIP_STEP), _Steps(_SLIP_ANGLE_STEP)
        self._nearness, self._force = _Steps(_NEAR_STEP), _Steps(_FORCE_STEP)
        self._limits: frozenset[str] = frozenset()
        self._grasps = False
        self._waiting: Pulse | None = None

    def start_pulse(self, event: Event) -> None:
        """Ask for the vibration that belongs to an event of the arm, if there is one."""
        if is_fault(event):
            self._want(FAULT)
        elif event.source == event.destination:
            if (pulse := _WHILE_STATE_STAYS.get(event.kind)) is not None:
                self._want(pulse)
            elif event.kind is TeleopReason.VERDICT and (keep := event.reason.detail["keep"]) is not None:
                self._want(EPISODE_KEPT if keep else EPISODE_REJECTED)
        elif event.destination in _BEGINS:
            self._want(_BEGINS[event.destination])
        elif event.source in (ArmState.ENGAGED, ArmState.CARRIED, ArmState.HOMING):
            self._want(PAUSED)

    def slip(self, slip: float, slip_angle: float) -> None:
        """Take the slip: how far leash and workspace have held the target back since the last anchor [m], [rad]."""
        position, rotation = self._slipped
        # The operator | calls both, because both have to be updated.
        if position.grew(slip) | rotation.grew(slip_angle):
            self._want(SLIP)

    def notice(self, condition: ArmCondition) -> None:
        """Ask for a vibration if the arm comes near to a body, its contact force grows, or it reaches a joint limit."""
        nearness = max(_NEAR_FROM - condition.spare, 0.0)
        if self._nearness.grew(nearness):
            self._want(NEAR.grown(nearness / _NEAR_FROM))
        if condition.limits - self._limits:
            self._want(LIMIT)
        self._limits = condition.limits
        if condition.force is not None and self._force.grew(condition.force):
            self._want(CONTACT.grown(condition.force / _FORCE_TO))

    def grasps(self, holds: bool) -> None:
        """Remember whether the gripper holds something. If it has begun to hold something, ask for a vibration."""
        if holds and not self._grasps:
            self._want(GRASP)
        self._grasps = holds

    def at(self, now: float, hand: str) -> HapticFeedback | None:
        """Return the message that begins or ends a vibration at ``now`` [s], or None.

        ``hand`` drives the arm now. A message that ends a vibration goes to the hand in which the vibration began.
        """
        if self._ends is not None and now >= self._ends:
            self._ends, self._next = None, now + _PAUSE
            # The vibration ends in the hand that felt it. Another hand may drive the arm now.
            return HapticFeedback(self._felt_by, 0.0, 0.0)
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
    """Counts the steps by which a quantity grows.

    A step that was counted is counted again only after the quantity has shrunk by two steps.
    """

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
