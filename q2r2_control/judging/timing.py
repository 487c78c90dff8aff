"""What is missing of an episode: ticks that came late, ticks that are not in the file, and its end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from q2r2_control.judging.episode import Episode

_LATE = 1.5  # periods


@dataclass(frozen=True, slots=True)
class TimingFigures:
    """Of all ticks, the end of the run included; None: there are none."""

    ticks: int  # that are in the file
    lost_ticks: int  # that are not, between the first and the last
    lost_share: float | None
    longest_lost_s: float  # of which no tick is in the file
    late_ticks: int  # more than 1.5 periods after the one before
    missed_ticks: int  # whole periods that passed meanwhile
    missed_share: float | None  # of those that were due
    longest_tick_s: float | None  # between two ticks of the loop
    compute_time_us_p99: float | None
    ended: bool  # the arms came to rest and the file was closed


def timing_figures(episode: Episode) -> TimingFigures:
    """Figures of an episode's ticks.

    A tick that was lost is one whose number is not in the file; the time of which no tick is in the file is what lies
    between its neighbours, less a period. Missed ticks are those of the loop, told from the time that each tick says
    has passed since the one before, which lost ticks do not change.
    """
    ticks = episode.ticks
    count = len(ticks.t)
    if not count:
        return TimingFigures(0, 0, None, 0.0, 0, 0, None, None, None, episode.ended)
    period = 1.0 / episode.config.loop_rate_hz
    lost = np.diff(ticks.number, prepend=-1) - 1  # the first tick of a run is number 0
    gaps = np.diff(ticks.t, prepend=0.0) - ticks.dt
    missed = int(np.maximum(np.round(ticks.dt / period) - 1, 0).sum())
    return TimingFigures(
        ticks=count,
        lost_ticks=int(lost.sum()),
        lost_share=float(lost.sum() / (lost.sum() + count)),
        longest_lost_s=float(gaps[lost > 0].max(initial=0.0)),
        late_ticks=int((ticks.dt > _LATE * period).sum()),
        missed_ticks=missed,
        missed_share=missed / (missed + count),
        longest_tick_s=float(ticks.dt.max()),
        compute_time_us_p99=1e6 * float(np.percentile(ticks.compute_time, 99)),
        ended=episode.ended,
    )
