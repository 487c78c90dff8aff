"""Turns messages into samples, and queues them between the receiving thread and the loop that polls."""

from __future__ import annotations

import threading
from collections import deque

from q2r2_control.inputs.messages import HandMessage, HandPose
from q2r2_control.types import SIDES, HandFault, HandInputs, HandSample

# Between two polls: 0.8 s of poses and inputs of two hands at 75 Hz; a loop that stalls for longer pauses all arms.
SAMPLES_KEPT = 256


class HandTracker:
    """Joins poses and inputs, which are separate messages, into samples with the newest of both.

    One tracker lives as long as one connection, so that no pose or button outlives the client that sent it.
    """

    def __init__(self) -> None:
        self._poses: dict[str, tuple[HandPose, float, HandFault | None]] = {}
        self._inputs: dict[str, tuple[HandInputs, float]] = dict.fromkeys(SIDES, (HandInputs(), float("-inf")))

    def update(self, hand: str, message: HandMessage, now: float, fault: HandFault | None = None) -> HandSample | None:
        """The sample after ``message`` came in at ``now`` [s]; None for a twist, or before the hand's first pose.

        ``fault``: why a pose must not be followed.
        """
        if isinstance(message, HandPose):
            self._poses[hand] = (message, now, fault)
        elif isinstance(message, HandInputs):
            self._inputs[hand] = (message, now)
        else:
            return None
        if hand not in self._poses:
            return None
        pose, pose_stamp, pose_fault = self._poses[hand]
        inputs, inputs_stamp = self._inputs[hand]
        return HandSample(hand, pose.position, pose.quaternion, pose_stamp, inputs, inputs_stamp, pose_fault)


class SampleQueue:
    """Bounded queue between two threads that keeps the newest samples, and shows a cut.

    After :meth:`cut` the next two takes are empty and :attr:`is_cut` stays true from the cut until the second: a loop
    that checks once a tick, before or after it takes, cannot miss that a connection was lost and made again in between,
    and so never reads two clients' poses as one motion.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._samples: deque[HandSample] = deque(maxlen=SAMPLES_KEPT)
        self._takes_owed = 0

    @property
    def is_cut(self) -> bool:
        return self._takes_owed > 0

    def put(self, sample: HandSample) -> None:
        """Append the newest sample."""
        with self._lock:
            self._samples.append(sample)

    def take(self) -> list[HandSample]:
        """All samples since the last take, oldest first."""
        with self._lock:
            if self._takes_owed:
                self._takes_owed -= 1
                return []
            samples = list(self._samples)
            self._samples.clear()
            return samples

    def cut(self) -> None:
        """The connection is lost: forget queued samples, which may be old."""
        with self._lock:
            self._samples.clear()
            self._takes_owed = 2
