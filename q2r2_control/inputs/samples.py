"""Make samples from the hands' messages, detect poses that must not be followed, and queue samples for the loop."""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.inputs.messages import HandMessage, HandPose, HandTwist
from q2r2_control.inputs.moved_frame import MovedFrame, PoseVerdict
from q2r2_control.inputs.session import Reception
from q2r2_control.types import SIDES, HandFault, HandInputs, HandSample

# Greatest number of samples kept between two polls: poses and inputs of two hands at 75 Hz for 0.8 s. If the loop
# stalls for longer, all arms pause anyway.
SAMPLES_KEPT = 256


class HandTracker:
    """Joins the poses and inputs of one connection. Each sample has a hand's newest pose and newest inputs."""

    def __init__(self) -> None:
        self._poses: dict[str, tuple[HandPose, float, HandFault | None]] = {}
        self._inputs: dict[str, tuple[HandInputs, float]] = dict.fromkeys(SIDES, (HandInputs(), float("-inf")))

    def update(self, hand: str, message: HandMessage, now: float, fault: HandFault | None = None) -> HandSample | None:
        """Return the sample after ``message`` was received at ``now`` [s]; None before the first pose and for a twist.

        ``fault`` is the fault of the pose in ``message``; None if it has none.
        """
        if isinstance(message, HandPose):
            self._poses[hand] = (message, now, fault)
        elif isinstance(message, HandInputs):
            self._inputs[hand] = (message, now)
        if isinstance(message, HandTwist) or hand not in self._poses:
            return None
        pose, pose_stamp, pose_fault = self._poses[hand]
        inputs, inputs_stamp = self._inputs[hand]
        return HandSample(hand, pose.position, pose.quaternion, pose_stamp, inputs, inputs_stamp, pose_fault)


class SampleQueue:
    """Bounded queue between two threads. It keeps the newest samples, and shows that the connection was lost.

    After :meth:`cut` the next two calls of :meth:`take` return nothing, and :attr:`is_cut` is True until the second
    call. A loop that checks :attr:`is_cut` once per tick, before or after :meth:`take`, therefore notices even a
    connection that was lost and made again at once. Such a loop never sees the poses of two clients as one motion.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._samples: deque[HandSample] = deque(maxlen=SAMPLES_KEPT)
        self._takes_owed = 0  # How many further calls of ``take`` return nothing.

    @property
    def is_cut(self) -> bool:
        return self._takes_owed > 0

    def put(self, sample: HandSample) -> None:
        with self._lock:
            self._samples.append(sample)

    def take(self) -> list[HandSample]:
        """Return all samples since the previous call of this method, oldest first."""
        with self._lock:
            if self._takes_owed:
                self._takes_owed -= 1
                return []
            samples = list(self._samples)
            self._samples.clear()
            return samples

    def cut(self) -> None:
        """Note that the connection is lost, and forget the queued samples, which can be old."""
        with self._lock:
            self._samples.clear()
            self._takes_owed = 2


# A pose that stays the same for this long is frozen [s]. In this time, a headset sends 37 poses, all changed by noise.
FROZEN_TIME = 0.5


class Watched(NamedTuple):
    """A message after the check of its pose."""

    reception: Reception
    stamp: float  # Time of receipt [s].
    fault: HandFault | None = None  # The fault of the message's pose; None if there is none.


class HandsWatch:
    """Finds poses of real hands that must not be followed: frozen poses, and poses after their frame has moved.

    Sensor noise changes each pose of a hand at rest, so a pose that stays the same is a copy of an old one. After the
    frame has moved, poses count as faulty for twice ``timeout``. If the receiver leaves faulty poses out, this is long
    enough to stop its arm. Poses are passed on without delay. Only a pose after an unusually large step may wait for
    the other hand's pose.
    """

    def __init__(
        self, frozen_time: float | None = FROZEN_TIME, frame: bool = True, timeout: float = STREAM_TIMEOUT
    ) -> None:
        """Make a watch.

        Args:
            frozen_time: A pose that stays the same for this long is frozen [s]; None if no pose counts as frozen.
            frame: Whether to detect that the frame of the poses has moved.
            timeout: Half the time for which poses are faulty after the frame has moved [s].
        """
        self._frozen_time, self._watches_frame, self._fault_time = frozen_time, frame, 2.0 * timeout
        self.reset()

    def reset(self) -> None:
        """Start again for a new connection, whose poses do not continue the motion of the last poses."""
        self._numbers: dict[str, bytes] = {}  # The numbers of each hand's newest pose.
        self._since: dict[str, float] = {}  # For each hand, the time at which its numbers last changed [s].
        self._frame = MovedFrame(self._fault_time) if self._watches_frame else None
        self._waiting: list[Watched] = []

    def receive(self, reception: Reception, now: float) -> list[Watched]:
        """Return the messages to pass on after ``reception`` has come at ``now`` [s], oldest first."""
        hand, message = reception.hand, reception.message
        if isinstance(message, HandInputs) and self._frame is not None:
            self._frame.take_inputs(hand, message, now)
        if not isinstance(message, HandPose) or reception.fault is not None or reception.virtual:
            return [Watched(reception, now, reception.fault)]
        numbers = message.position.tobytes() + message.quaternion.tobytes()
        if numbers != self._numbers.get(hand):
            self._numbers[hand], self._since[hand] = numbers, now
        frozen = self._frozen_time is not None and now - self._since[hand] >= self._frozen_time
        watched = Watched(reception, now, HandFault.FROZEN if frozen else None)
        verdict = PoseVerdict.FOLLOW if self._frame is None else self._frame.receive(hand, message, now)
        waited, self._waiting = self._waiting, []
        match verdict:
            case PoseVerdict.FOLLOW:
                return [*waited, watched]
            case PoseVerdict.WAIT:
                self._waiting = [watched]
                return waited
            case PoseVerdict.DROP:
                return []
            case PoseVerdict.FAULT:
                return [watched._replace(fault=HandFault.FRAME_MOVED)]
