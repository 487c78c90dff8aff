"""Detect that the coordinate frame of the measured hand poses has moved, and not the hands.

A frame moves in one step if the headset is recentred. The motion lasts longer if something carries the frame along,
such as the operator's head. In both cases the two hands seem to move as one rigid body, and no arm may follow this
motion. Human hands do not move as one rigid body, because each hand trembles and turns by itself.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.inputs.messages import HandPose
from q2r2_control.types import SIDES, Array, HandInputs

_FARTHEST = 1e3  # Greatest allowed coordinate of a hand. No tracking system measures larger coordinates [m].


class Move(NamedTuple):
    """The size of a motion from one pose to another, or a limit on this size."""

    distance: float  # [m]
    angle: float  # [rad]


class Place(NamedTuple):
    """The pose of a hand, in the input's frame."""

    position: Array  # (3,) [m]
    rotation: Array  # (3, 3)

    @classmethod
    def of(cls, pose: HandPose) -> Place | None:
        """Return the pose with a rotation matrix; None if the numbers in ``pose`` cannot be a pose."""
        length = math.sqrt(float(pose.quaternion @ pose.quaternion))
        if not 0.5 <= length <= 2.0 or not float(np.abs(pose.position).max()) <= _FARTHEST:
            return None
        return cls(pose.position, pin.Quaternion(pose.quaternion / length).toRotationMatrix())


class HandPair(NamedTuple):
    """The poses of both hands at one time, and the quantities that do not change if they move as one rigid body."""

    t: float  # [s]
    left: Place
    right: Place
    seen: Array  # (3,) Vector from the left to the right hand, in the left hand's axes [m].
    apart: float  # Distance between the hands [m].
    turn: Array  # (3, 3) Rotation of the right hand's axes in the left hand's axes.

    @classmethod
    def of(cls, t: float, left: Place, right: Place) -> HandPair:
        between = right.position - left.position
        return cls(t, left, right, left.rotation.T @ between, math.hypot(*between), left.rotation.T @ right.rotation)


def moved_as_one(before: HandPair, after: HandPair, tolerance: Move) -> bool:
    """Return whether the hands can have moved as one rigid body between two times.

    If they have, their distance, their relative rotation and the vector between them are the same ``before`` and
    ``after``, up to the ``tolerance``.

    Suppose that the left hand's measured rotation has an error of the tolerance's angle. In the left hand's axes, the
    right hand then seems to move, by this angle times the distance between the hands. The bound on ``seen`` includes
    this motion. Without it, less noise of the rotation would be allowed than the tolerance says.
    """
    shift = math.dist(after.seen, before.seen)
    if (
        abs(after.apart - before.apart) > tolerance.distance
        or shift > tolerance.distance + tolerance.angle * after.apart
    ):
        return False
    return 0.5 * (float(np.vdot(before.turn, after.turn)) - 1.0) >= math.cos(tolerance.angle)


# A motion from one sample to the next is a step if two conditions hold. It is larger than _STEP, and it is larger than
# _STANDS_OUT times each of the last _BEFORE motions. A hand that starts from rest makes such a motion only if it
# accelerates at over 30 m/s^2. Its mean speed between two samples is then 0.7 m/s.
_STEP = Move(0.010, math.radians(2.0))
_STANDS_OUT, _BEFORE = 3.0, 4
_PERIOD = 1.0 / 72.0  # Period of samples [s]. The time between two samples is shorter if the first one was delayed.
_STEP_TOLERANCE = Move(0.002, math.radians(0.75))
# From rest, hands that accelerate at 20 m/s^2 and 70 rad/s^2 move by _STEP in this time [s]. If the time between two
# samples is longer, the allowed motion grows with the square of the ratio of both times.
_STEP_GAP = 0.032
# The next constants concern a frame that is carried along.
_WINDOW = 1.5  # Duration of the recent motion that is judged [s].
_CARRIED = 0.15  # Least distance that both hands have to move [m].
_NEAR = 0.4 * _CARRIED  # If the left hand stays this near to one position, the frame is not carried along [m].
_CARRIED_TOLERANCE = Move(0.001, math.radians(0.5))
_SAME_TIME = 0.01  # Messages of the two hands within this time belong together [s].
_ALIVE = 0.05  # A pose does not wait for the other hand if that hand has had no pose for longer than this [s].
_LONGEST_GAP = 0.15  # The motion between two poses of a hand is not judged if the time between them is longer [s].
# A moved frame counts as a fault only after this delay [s]. If the operator has aligned the frame, the message with the
# pressed buttons can come after the first poses in the new frame.
_CHORD_TIME = 0.04
# A pose within this time after the press of an alignment is dropped, so that the receiver gets the buttons first [s].
_CHORD_SEEN = 0.01


class PoseVerdict(Enum):
    """What the receiver of a pose has to do with it."""

    FOLLOW = "as it is"
    WAIT = "not before the other hand's next pose has come"
    DROP = "nobody needs to see it: what it means is told soon"
    FAULT = "not to be followed"


class MovedFrame:
    """Judges the poses of both hands when they are received. Times are receipt times [s]."""

    def __init__(self, fault_time: float) -> None:
        """Make a detector. After the frame has moved, poses count as faulty for ``fault_time`` [s]."""
        self._fault_time = fault_time
        # For each hand that holds both buttons to align the frame, the time since which it holds them [s].
        self._chords: dict[str, float] = {}
        self.reset()

    def reset(self) -> None:
        """Forget everything that was received, except which hand holds the buttons of an alignment."""
        self._motions = {hand: _HandMotion() for hand in SIDES}
        self._pairs: deque[HandPair] = deque()
        # Since this pair, the left hand has stayed within _NEAR of its position in the pair. The pair is set if
        # ``_pairs`` is not empty.
        self._near: HandPair
        # The time at which a step of the hands' frame was detected [s]; None if there is no such step. The step is
        # possibly the operator's alignment.
        self._suspected: float | None = None
        self._bad_until = -math.inf  # Until this time, poses count as faulty [s].

    def take_inputs(self, hand: str, inputs: HandInputs, now: float) -> None:
        """Take the buttons of a hand. With both buttons the operator aligns the frame, which may then move."""
        if inputs.button_upper and inputs.button_lower:
            self._chords.setdefault(hand, now)
            self.reset()
        else:
            self._chords.pop(hand, None)

    def receive(self, hand: str, pose: HandPose, now: float) -> PoseVerdict:
        """Take a pose of ``hand`` that was received at ``now`` [s], and return what to do with it."""
        place = Place.of(pose)
        if self._chords or place is None:
            self._motions[hand] = _HandMotion()
            just_now = now - min(self._chords.values(), default=-math.inf) < _CHORD_SEEN
            return PoseVerdict.DROP if just_now else PoseVerdict.FOLLOW
        motion, other = self._motions[hand], self._motions["right" if hand == "left" else "left"]
        if not motion.add(place, now):
            self._pairs.clear()
        other.is_new = other.is_new and now - other.stamp <= _SAME_TIME
        if other.is_new:  # The other hand's pose was received at nearly the same time.
            motion.is_new = other.is_new = False
            self._judge(HandPair.of(now, *(self._motions[side].place for side in SIDES)), now)
        if self._suspected is not None:
            if now - self._suspected < _CHORD_TIME:
                return PoseVerdict.DROP
            self._suspected, self._bad_until = None, now + self._fault_time
        if now < self._bad_until:
            return PoseVerdict.FAULT
        waits = motion.stands_out and motion.is_new and now - other.stamp < _ALIVE
        return PoseVerdict.WAIT if waits else PoseVerdict.FOLLOW

    def _judge(self, pair: HandPair, now: float) -> None:
        pairs = self._pairs
        steps = pairs and all(motion.stands_out for motion in self._motions.values())
        if steps and moved_as_one(pairs[-1], pair, _STEP_TOLERANCE):
            self._suspected = now if self._suspected is None else self._suspected
            pairs.clear()
        if not pairs:
            self._near = pair
        pairs.append(pair)
        while pairs[0].t < now - _WINDOW:
            pairs.popleft()
        if math.dist(pair.left.position, self._near.left.position) > _NEAR:
            self._near = pair
        # If the left hand has stayed near one position for the whole window, the frame was not carried along. A hand at
        # rest therefore costs no further computation.
        if self._near.t > pairs[0].t and _carried(pairs):
            self._bad_until = now + self._fault_time
            pairs.clear()


class _HandMotion:
    """The recent motion of one hand."""

    place: Place  # The newest pose. It is set when the first pose is added.

    def __init__(self) -> None:
        self.stamp = -math.inf
        self.is_new = False  # Whether the newest pose has not yet been paired with a pose of the other hand.
        self.stands_out = False  # Whether the newest motion is a step.
        self._moves: deque[Move] = deque(maxlen=_BEFORE)

    def add(self, place: Place, now: float) -> bool:
        """Add a pose that came at ``now`` [s]. Return whether it follows the last pose without a long gap in time."""
        gap = now - self.stamp
        goes_on = gap <= _LONGEST_GAP
        if goes_on:
            angle = math.hypot(*pin.log3(self.place.rotation.T @ place.rotation))
            move = Move(math.dist(place.position, self.place.position), angle)
            self.stands_out = len(self._moves) == _BEFORE and self._is_step(move, gap)
            self._moves.append(move)
        else:
            self._moves.clear()
            self.stands_out = False
        self.place, self.stamp, self.is_new = place, now, True
        return goes_on

    def _is_step(self, move: Move, gap: float) -> bool:
        scale, usual = max(gap / _STEP_GAP, 1.0) ** 2, _STANDS_OUT * max(gap / _PERIOD, 1.0)
        distance = max(scale * _STEP.distance, usual * max(before.distance for before in self._moves))
        angle = max(scale * _STEP.angle, usual * max(before.angle for before in self._moves))
        return move.distance > distance or move.angle > angle


def _carried(pairs: deque[HandPair]) -> bool:
    """Return whether both hands have moved far since an earlier pair, and always as one rigid body."""
    newest = pairs[-1]
    for pair in list(pairs)[-2::-1]:
        if not moved_as_one(pair, newest, _CARRIED_TOLERANCE):
            return False
        distances = (
            math.dist(pair.left.position, newest.left.position),
            math.dist(pair.right.position, newest.right.position),
        )
        if min(distances) > _CARRIED:
            return True
    return False
