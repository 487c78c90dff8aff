"""The ticks of a recording as columns: one row for each tick, whatever topic a number is of."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.errors import RecordingError
from q2r2_control.recording import topics as names
from q2r2_control.recording.reader import RecordedChunk, Recording
from q2r2_control.recording.rows import Rows
from q2r2_control.types import Array

Column = npt.NDArray[Any]

_OF_EVERY_TICK = (names.TICK, names.JOINT_STATES, names.REFERENCE, names.GRIPPERS, names.FLAGS)


class ChunkTicks:
    """The n ticks of one chunk. Raises :class:`ValueError` and :class:`KeyError` where one lacks a message."""

    def __init__(self, chunk: RecordedChunk, recording: Recording) -> None:
        self.chunk = chunk
        self._arms, self._topics = recording.about.arms, recording.topics
        self.numbers: npt.NDArray[np.int64] = chunk.rows[names.TICK]["sequence"].astype(np.int64)  # from 0 on
        self.times: npt.NDArray[np.int64] = chunk.rows[names.TICK]["log_time"].astype(np.int64)  # of day [ns]
        for topic in (*_OF_EVERY_TICK, *map(names.safe_target, self._arms)):
            if len(chunk.rows[topic]) != len(self.numbers):
                raise ValueError(f"a message of {topic} is missing")

    def rows(self, topic: str) -> Rows:
        """Messages of a topic that every tick has one of."""
        return self.chunk.rows[topic]

    def number(self, topic: str, label: str) -> Array:
        """(n,) one number of the arrays of a topic."""
        return np.asarray(self.rows(topic)["data"][:, self._topics.by_name[topic].labels["data"].index(label)])

    def of_arms(self, topic: str, what: str) -> Array:
        """(n, arms) one number of each arm."""
        return np.stack([self.number(topic, f"{what}_{arm}") for arm in self._arms], axis=1)

    def reference_tools(self) -> Array:
        """(n, arms, 7) x y z [m] qx qy qz qw of the tools at the reference, in the world."""
        return np.stack([_poses(self.rows(names.safe_target(arm))) for arm in self._arms], axis=1)

    def targets(self, otherwise: Array) -> Array:
        """(n, arms, 7) what the operator asks for, and ``otherwise`` (n, arms, 7) where that is nothing.

        Raises :class:`ValueError` for a target of a tick that is not there.
        """
        targets = otherwise.copy()
        for index, arm in enumerate(self._arms):
            asked = self.chunk.rows.get(names.target(arm))
            if asked is not None:
                at = np.searchsorted(self.numbers, asked["sequence"])
                if (at == len(self.numbers)).any() or (self.numbers[at] != asked["sequence"]).any():
                    raise ValueError("a target without a tick")
                targets[at, index] = _poses(asked)
        return targets


def ticks_of(recording: Recording) -> Iterator[ChunkTicks]:
    """All ticks, some half a second at a time; some may be missing in between, where they were lost.

    Raises :class:`RecordingError` for a damaged file, and where ticks are not in order.
    """
    last_number, last_time = -1, 0
    for chunk in recording.chunks():
        if names.TICK not in chunk.rows:
            continue
        try:
            ticks = ChunkTicks(chunk, recording)
        except (KeyError, ValueError, IndexError) as error:
            raise RecordingError(f"{recording.file}: damaged: a tick without all of its messages") from error
        steps = np.diff(ticks.numbers, prepend=last_number), np.diff(ticks.times, prepend=last_time)
        if (steps[0] < 1).any() or (steps[1] < 0).any():
            raise RecordingError(f"{recording.file}: damaged: ticks are not in the order of time")
        last_number, last_time = int(ticks.numbers[-1]), int(ticks.times[-1])
        yield ticks


def _poses(rows: Rows) -> Array:
    return np.concatenate((rows["position"], rows["quaternion"]), axis=1)
