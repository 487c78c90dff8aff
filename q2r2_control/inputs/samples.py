"""Makes samples of messages, but of poses that are no motion of the hands, and queues them for the loop."""

from __future__ import annotations

import threading
from collections import deque
from typing import NamedTuple

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.inputs.messages import HandMessage, HandPose, HandTwist
from q2r2_control.inputs.moved_frame import MovedFrame, PoseVerdict
from q2r2_control.inputs.session import Reception
from q2r2_control.types import SIDES, HandFault, HandInputs, HandSample

# Between two polls: 0.8 s of poses and inputs of two hands at 75 Hz; a loop that stalls for longer pauses all arms.
SAMPLES_KEPT = 256


class HandTracker:
    """Joins the poses and inputs of one connection into samples with the newest of both."""

    def __init__(self) -> None:
        self._poses: dict[str, tuple[HandPose, float, HandFault | None]] = {}
        self._inputs: dict[str, tuple[HandInputs, float]] = dict.fromkeys(SIDES, (HandInputs(), float("-inf")))

    def update(self, hand: str, message: HandMessage, now: float, fault: HandFault | None = None) -> HandSample | None:
        """The sample after ``message`` came at ``now`` [s], a pose with its ``fault``; None before the first pose."""
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
    """Bounded queue between two threads that keeps the newest samples, and shows a cut.

    After :meth:`cut` the next two takes are empty, and :attr:`is_cut` is true until the second. A loop that checks once
    a tick, before or after it takes, cannot miss a connection that was lost and made again. It never reads two clients'
    poses as one motion.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._samples: deque[HandSample] = deque(maxlen=SAMPLES_KEPT)
        self._takes_owed = 0  # that return nothing

    @property
    def is_cut(self) -> bool:
        return self._takes_owed > 0

    def put(self, sample: HandSample) -> None:
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


FROZEN_TIME = 0.5  # 37 samples of a headset whose noise changes each of them [s]


class Watched(NamedTuple):
    reception: Reception
    stamp: float  # receipt time [s]
    fault: HandFault | None = None  # of a pose


class HandsWatch:
    """Finds poses of real hands that must not be followed: frozen ones, and those of a frame that moved.

    Sensor noise changes each pose of a hand at rest: one that stays the same is the copy of an old one. A fault of the
    frame lasts for twice ``timeout``, after which watches for missing data have noticed that faulty poses are left out.
    No message is late but for a pose that stands out: it may wait for the other hand's.
    """

    def __init__(
        self, frozen_time: float | None = FROZEN_TIME, frame: bool = True, timeout: float = STREAM_TIMEOUT
    ) -> None:
        """``frozen_time`` [s]: a pose may stay the same, None: for ever; ``frame``: whether to watch the frame."""
        self._frozen_time, self._watches_frame, self._fault_time = frozen_time, frame, 2.0 * timeout
        self.reset()

    def reset(self) -> None:
        """A new connection: what comes from now on is not the motion of what came before."""
        self._numbers: dict[str, bytes] = {}  # of each hand's newest pose
        self._since: dict[str, float] = {}  # when they last changed [s]
        self._frame = MovedFrame(self._fault_time) if self._watches_frame else None
        self._waiting: list[Watched] = []

    def receive(self, reception: Reception, now: float) -> list[Watched]:
        """The samples to hand on after ``reception`` came at ``now`` [s], in this order."""
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
