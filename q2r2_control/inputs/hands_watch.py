"""What a headset sends although it is not where the hands are: frozen poses, and a frame that moved."""

from __future__ import annotations

from typing import NamedTuple

from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.inputs.messages import HandPose
from q2r2_control.inputs.moved_frame import MovedFrame, PoseVerdict
from q2r2_control.inputs.session import Reception
from q2r2_control.types import SIDES, HandFault, HandInputs

FROZEN_TIME = 0.5  # 37 samples of a headset whose noise changes each of them [s]


class Watched(NamedTuple):
    """A message to hand on."""

    reception: Reception
    stamp: float  # receipt time [s]
    fault: HandFault | None = None  # of a pose


class FrozenPose:
    """Finds a pose of one hand that is the copy of an old one: sensor noise changes those of a hand at rest."""

    def __init__(self, allowed: float | None) -> None:
        """``allowed``: a pose may stay the same for this long [s]; None: for ever."""
        self._allowed = allowed
        self._numbers, self._since = b"", 0.0

    def receive(self, pose: HandPose, now: float) -> bool:
        """Whether ``pose``, received at ``now`` [s], has been the same for too long. Stamp and frame do not count."""
        numbers = pose.position.tobytes() + pose.quaternion.tobytes()
        if numbers != self._numbers:
            self._numbers, self._since = numbers, now
        return self._allowed is not None and now - self._since >= self._allowed


class HandsWatch:
    """Stands between a headset's messages and whoever follows them; for poses of real hands, not of scripts.

    A fault of the frame lasts for twice ``timeout``, after which whoever watches for missing data has noticed where
    faulty poses are left out. No message is late but for a pose that stands out: it may wait for the other hand's.
    """

    def __init__(
        self, frozen_time: float | None = FROZEN_TIME, frame: bool = True, timeout: float = STREAM_TIMEOUT
    ) -> None:
        """``frozen_time`` [s]: see :class:`FrozenPose`; ``frame``: whether to look for a frame that moved."""
        self._frozen_time = frozen_time
        self._fault_time = 2.0 * timeout
        self._watches_frame = frame
        self.reset()

    def reset(self) -> None:
        """A new connection: what comes from now on is not the motion of what came before."""
        self._frozen = {hand: FrozenPose(self._frozen_time) for hand in SIDES}
        self._frame = MovedFrame(self._fault_time) if self._watches_frame else None
        self._waiting: list[Watched] = []

    def receive(self, reception: Reception, now: float) -> list[Watched]:
        """What to hand on after ``reception`` came at ``now`` [s], in this order."""
        hand, message = reception.hand, reception.message
        if isinstance(message, HandInputs) and self._frame is not None:
            self._frame.take_inputs(hand, message, now)
        if not isinstance(message, HandPose):
            return [Watched(reception, now)]
        frozen = self._frozen[hand].receive(message, now)
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
