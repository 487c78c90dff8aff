"""Plays hands whose poses and buttons are functions of time, the same at every run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import pinocchio as pin

from q2r2_control.inputs.sampling import SampleTiming
from q2r2_control.types import QUEST_CONTROLS, HandInputs, HandSample, HapticFeedback

HandPose = Callable[[str, float], pin.SE3]  # hand, time since the first poll [s] -> pose in the input's frame
HandButtons = Callable[[str, float], HandInputs]  # hand, time since the first poll [s]

# The play pauses when it is not polled for longer than this [s].
_LONGEST_BACKLOG = 1.0


class PlayedInput:
    """Samples of hands along given ways, from the first poll on. Implements :class:`Input`.

    The samples of each hand come about as its ``samplings`` say, and do not depend on when they are polled.
    """

    controls = QUEST_CONTROLS

    def __init__(self, pose: HandPose, inputs: HandButtons, samplings: Mapping[str, SampleTiming]) -> None:
        self._pose, self._inputs = pose, inputs
        self._streams = [self._samples(hand, sampling) for hand, sampling in samplings.items()]
        self._next = [next(stream) for stream in self._streams]
        self._due = self._first_due()
        self._origin: float | None = None
        self._connected = False

    @property
    def connected(self) -> bool:
        """Between ``start`` and ``close``."""
        return self._connected

    def start(self) -> None:
        """Let polls return samples."""
        self._connected = True

    def close(self) -> None:
        """Let polls return nothing any more."""
        self._connected = False

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Does nothing: what is played has no vibration."""

    def hand_pose(self, hand: str, t: float) -> pin.SE3:
        """Where ``hand`` ideally is at ``t`` [s], on the clock of the samples' stamps; play time before any poll."""
        return self._pose(hand, t - (self._origin or 0.0))

    def poll(self, now: float) -> list[HandSample]:
        """Samples that came due since the last poll, with the time they were due as receipt time; oldest first."""
        if not self._connected or not math.isfinite(now):
            return []
        if self._origin is None:
            self._origin = now
        backlog = now - self._origin - self._due
        if backlog < 0.0:
            return []  # as at most polls
        self._origin += max(backlog - _LONGEST_BACKLOG, 0.0)
        samples = []
        for index, stream in enumerate(self._streams):
            while self._next[index].due <= now - self._origin:
                samples.append(self._next[index].received(self._origin))
                self._next[index] = next(stream)
        self._due = self._first_due()
        return sorted(samples, key=lambda sample: sample.pose_stamp)

    def due(self) -> float:
        """When the next sample comes due, on the clock of the polls [s]; inf where there was no poll yet."""
        if self._origin is None:
            return math.inf
        return self._origin + self._due

    def _first_due(self) -> float:
        """When the next sample comes due in play time [s]; inf where there is no hand."""
        return min((sample.due for sample in self._next), default=math.inf)

    def _samples(self, hand: str, sampling: SampleTiming) -> Iterator[_Played]:
        for t in sampling.times():
            pose = sampling.measured(self._pose(hand, t), t)
            yield _Played(t + sampling.lateness(), hand, pose, self._inputs(hand, t))


@dataclass(frozen=True, slots=True)
class _Played:
    due: float  # receipt in play time [s]
    hand: str
    pose: pin.SE3
    inputs: HandInputs

    def received(self, origin: float) -> HandSample:
        stamp = origin + self.due
        quaternion = pin.Quaternion(self.pose.rotation).coeffs()
        return HandSample(self.hand, self.pose.translation.copy(), quaternion, stamp, self.inputs, stamp)
