"""How well the samples of a hand came, while it led an engaged arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from q2r2_control.judging.episode import Episode, Flags
from q2r2_control.types import Array

_SHORTEST = 1e-3  # of a time in which an arm counts as engaged [s]


@dataclass(frozen=True, slots=True)
class HandFigures:
    """One hand, over the time for which the arm that it leads is engaged; None: that never is."""

    arm: str
    pose_rate_hz: float | None  # poses received, by the time
    dropouts: int  # times between two poses that are longer than a dropout
    dropout_share: float | None  # of the time that is within them
    longest_gap_s: float | None  # between two poses
    unusable_poses: int  # that are no numbers
    sample_age_ms_p50: float | None  # from the receipt of a pose to the tick that took it
    sample_age_ms_p99: float | None


def hand_figures(episode: Episode, hand: str, dropout: float) -> HandFigures:
    """Figures of a hand's samples; ``dropout`` [s] is the longest time between poses that is none.

    A time between poses counts as far as its arm is engaged in it, so that a headset that rests on the table spoils
    nothing. The time from the last pose to the end of the run is one as well; one in which ticks were lost is none,
    since samples are lost with them.
    """
    ticks, samples = episode.ticks, episode.hands[hand]
    engaged = ticks.engaged[:, episode.arms.index(samples.arm)] & ticks.following
    steps = np.where(engaged, ticks.dt, 0.0)
    passed = np.cumsum(steps)  # while engaged [s]
    total = float(passed[-1]) if len(passed) else 0.0
    unusable = ~np.isfinite(samples.position).all(axis=1)
    if total < _SHORTEST:
        return HandFigures(samples.arm, None, 0, None, None, int(unusable.sum()), None, None)
    usable = ~unusable & np.isfinite(samples.received)
    received = np.unique(samples.received[usable])
    taken = usable & _at(ticks.t, engaged, samples.polled)
    ages = samples.polled[taken] - samples.received[taken]
    ends = np.concatenate(([ticks.t[engaged][0]], received, [ticks.t[engaged][-1]]))
    ends = np.maximum.accumulate(ends)
    gaps, inside = np.diff(ends), np.diff(np.interp(ends, ticks.t, passed))
    lost = np.flatnonzero(np.diff(ticks.number) > 1)  # samples may be lost with the ticks after these
    with_lost = np.searchsorted(ticks.t[lost + 1], ends[:-1]) < np.searchsorted(ticks.t[lost], ends[1:], side="right")
    counting = (inside > _SHORTEST) & ~with_lost
    long = counting & (gaps > dropout)
    return HandFigures(
        arm=samples.arm,
        pose_rate_hz=float(_at(ticks.t, engaged, received).sum() / total),
        dropouts=int(long.sum()),
        dropout_share=float(inside[long].sum() / total),
        longest_gap_s=float(gaps[counting].max(initial=0.0)),
        unusable_poses=int(unusable.sum()),
        sample_age_ms_p50=None if not len(ages) else 1e3 * float(np.percentile(ages, 50)),
        sample_age_ms_p99=None if not len(ages) else 1e3 * float(np.percentile(ages, 99)),
    )


def _at(t: Array, flags: Flags, when: Array) -> Flags:
    """The newest of ``flags`` (n,), of times ``t`` (n,), at or before each of the times ``when``."""
    at = np.searchsorted(t, when, side="right") - 1
    return np.asarray((at >= 0) & flags[np.maximum(at, 0)])
