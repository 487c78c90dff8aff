"""How long it takes from a press of a hand until its arm moves, the first time and later. Imports no ROS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from q2r2_control.types import Array

WATCHED = 0.5  # after a press [s]
_MOVES = 0.02  # a joint command that is faster belongs to a motion [rad/s]


@dataclass(frozen=True, slots=True)
class PressRecording:
    """What followed one press that was to engage an arm at rest; times of one clock [s], ascending."""

    press: float  # when it was published
    ticks: Sequence[float]  # of the arm's node, when each had ended; some from before the press
    targets: Sequence[float]  # when each target was published
    commands: Sequence[float]  # when each joint command was published
    speeds: Sequence[float]  # of each of these, the fastest joint's [rad/s]


@dataclass(frozen=True, slots=True)
class PressRow:
    """Presses of one kind. Medians and maxima, in ms from the press; None where none was answered."""

    press: str  # which
    count: int
    unanswered: int  # within half a second
    tick_p50_ms: float | None  # the longest time from one tick of the arm's node to the next, in that half second
    tick_max_ms: float | None
    target_p50_ms: float | None  # until the first target
    target_max_ms: float | None
    motion_p50_ms: float | None  # until the first joint command that moves
    motion_max_ms: float | None


@dataclass(frozen=True, slots=True)
class PressReport:
    """What ``q2r2 bench --ros`` measured of presses."""

    starts: int  # of the set of nodes, with one first press each
    period_ms: float  # from one tick of the arm's node to the next, as a rule
    rows: tuple[PressRow, ...]

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def press_report(runs: Sequence[Sequence[PressRecording]]) -> PressReport:
    """Of runs of a set of nodes, each with the recordings of its presses in their order, at least one."""
    gaps = np.concatenate([np.diff(recording.ticks) for run in runs for recording in run])
    first, later = [run[0] for run in runs], [recording for run in runs for recording in run[1:]]
    return PressReport(len(runs), 1e3 * float(np.median(gaps)), (_row("first", first), _row("later", later)))


def _row(press: str, recordings: Sequence[PressRecording]) -> PressRow:
    times = [_times(recording) for recording in recordings]
    answered = np.array([time for time in times if time is not None]).reshape(-1, 3)
    unanswered = len(times) - len(answered)
    if not len(answered):
        return PressRow(press, len(times), unanswered, *[None] * 6)
    both = 1e3 * np.stack([np.median(answered, axis=0), answered.max(axis=0)], axis=1)
    return PressRow(press, len(times), unanswered, *both.ravel().tolist())


def _times(recording: PressRecording) -> tuple[float, float, float] | None:
    """The longest tick, and from the press until the first target and the first motion [s]."""
    press = recording.press
    target = _first(np.asarray(recording.targets), press)
    moving = np.asarray(recording.commands)[np.asarray(recording.speeds) > _MOVES]
    motion = _first(moving, press)
    if target is None or motion is None:
        return None
    ticks = np.asarray(recording.ticks)
    # What the press may hold up begins at the tick before it.
    begin, end = np.searchsorted(ticks, [press, press + WATCHED])
    longest = float(np.diff(ticks[max(begin - 1, 0) : end + 1]).max(initial=0.0))
    return longest, target, motion


def _first(times: Array, press: float) -> float | None:
    """How long after the press the first of ``times`` is, where that is watched yet [s]."""
    after = times[(times >= press) & (times <= press + WATCHED)]
    return float(after[0] - press) if len(after) else None
