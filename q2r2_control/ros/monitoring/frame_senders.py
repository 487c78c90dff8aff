"""Frames on /tf that two publishers send: a robot that is in two places."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import NamedTuple

from tf2_msgs.msg import TFMessage

from q2r2_control.ros.bridge.serialized import MessageReader
from q2r2_control.supervision.sequence_watch import SequenceWatch

_KEPT = 16  # messages that one node of a process has read and another may still have to
_PAUSE = 1.0  # after a silence of this long a publisher may have been restarted [s]
_REMEMBERED = 2.0  # a frame counts as sent by two for this long after it was last found to be [s]


class FrameSenders:
    """Tells two publishers of one frame from one, by the numbers of the messages that the frame comes in.

    Other publishers of the same topic that send other frames are as it should be. Times are the steady clock's [s].
    """

    def __init__(self) -> None:
        self._numbers: dict[str, SequenceWatch] = {}
        self._shared: dict[str, float] = {}

    def take(self, frame: str, number: int | None, now: float) -> bool:
        """A frame came in the message of this number, which some middleware does not tell; whether two send it."""
        if number is None:
            return False
        if (watch := self._numbers.get(frame)) is None:
            watch = self._numbers[frame] = SequenceWatch()
        if watch.take(number, now, _PAUSE) < 2:
            return False
        self._shared[frame] = now
        return True

    def shared(self, now: float) -> tuple[str, ...]:
        """The frames that two publishers send."""
        return tuple(sorted(frame for frame, at in self._shared.items() if now - at <= _REMEMBERED))


class ReadTransform(NamedTuple):
    """One transform of a message on /tf."""

    child_frame_id: str
    frame_id: str
    numbers: Sequence[float]  # position [m] and quaternion x y z w


@cache
def frame_reader() -> Callable[[bytes], Sequence[ReadTransform]]:
    """A function that reads the transforms in a serialized message; none where it is no message.

    A robot's message has dozens of transforms, fifty times a second; each is read once for all nodes of a process.
    """
    reader = MessageReader(TFMessage)

    @lru_cache(maxsize=_KEPT)
    def read(message: bytes) -> Sequence[ReadTransform]:
        if (told := reader.read(message)) is None:
            return ()  # which is some other node's fault
        rows = told.values.reshape(-1, 7).tolist()
        names = ((one.child_frame_id, one.header.frame_id) for one in told.like.transforms)
        return tuple(ReadTransform(*both, row) for both, row in zip(names, rows, strict=True))

    return read
