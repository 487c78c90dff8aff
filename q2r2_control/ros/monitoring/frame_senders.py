"""Frames on /tf that two publishers send: a robot that is in two places."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from geometry_msgs.msg import TransformStamped
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.serialization import deserialize_message
from tf2_msgs.msg import TFMessage

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


@lru_cache(maxsize=_KEPT)
def read_transforms(message: bytes) -> Sequence[ReadTransform]:
    """The transforms in a serialized TFMessage; none where it is no message.

    A robot's message has dozens of transforms, fifty times a second; each is read once for all nodes of a process.
    """
    try:
        transforms = deserialize_message(message, TFMessage).transforms
    except rclpy_implementation.RMWError:
        return ()  # which is some other node's fault
    return tuple(_read(one) for one in transforms)


def _read(transform: TransformStamped) -> ReadTransform:
    p, o = transform.transform.translation, transform.transform.rotation
    return ReadTransform(transform.child_frame_id, transform.header.frame_id, (p.x, p.y, p.z, o.x, o.y, o.z, o.w))
