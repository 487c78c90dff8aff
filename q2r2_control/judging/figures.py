"""All numbers of an episode."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from q2r2_control.events import ReasonKind
from q2r2_control.judging.camera_figures import CameraFigures, camera_figures
from q2r2_control.judging.episode import Episode
from q2r2_control.judging.measured import MeasuredFigures, measured_figures
from q2r2_control.judging.motion import ArmFigures, arm_figures, idle_share
from q2r2_control.recording.about import LOOP
from q2r2_control.recording.clock_steps import clock_steps
from q2r2_control.recording.messages import hand_pose, loop_topics, target
from q2r2_control.teleop.arm_states import is_fault, is_refusal
from q2r2_control.types import Array, Flags
from q2r2_control.wording import sentence

_SURELY = 100  # frames, a second, with a target, so that its topic has one whatever its rate
_SHORTEST = 1e-3  # of a time in which an arm counts as engaged [s]


@dataclass(frozen=True, slots=True)
class HandFigures:
    """One hand, over the time for which it leads its engaged arm; None: that never is."""

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

    A time between poses, or from the last one to the end, counts as far as it leads its arm and no tick was lost.
    """
    ticks, samples = episode.ticks, episode.hands[hand]
    engaged = (ticks.engaged & ~ticks.by_policy)[:, episode.arms.index(samples.arm)] & ticks.following
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


_LATE = 1.5  # periods


@dataclass(frozen=True, slots=True)
class Fault:
    """A pause that no operator asked for."""

    t: float  # since the run began [s]
    arm: str
    kind: str  # of the event's reason
    reason: str  # in words


@dataclass(frozen=True, slots=True)
class TimingFigures:
    """Of all ticks, the end of the run included; None: there are none."""

    ticks: int  # that are in the file
    lost_ticks: int  # Number of ticks between the first and the last one that the recording lacks.
    lost_share: float | None
    longest_lost_s: float  # of which no tick is in the file
    late_ticks: int  # more than 1.5 periods after the one before
    missed_ticks: int  # whole periods that passed meanwhile
    missed_share: float | None  # of those that were due
    longest_tick_s: float | None  # between two ticks of the loop
    compute_time_us_p99: float | None
    ended: bool  # the arms came to rest and the file was closed
    repeated_stamps: int | None  # ticks with a time that the one before had; None of nodes, whose receipts may coincide
    clock_step_s: float  # the largest by which a clock was set meanwhile; negative: back; 0: none was
    begins_again: bool  # the run goes on after it has begun to end: there are two in one file


@dataclass(frozen=True, slots=True)
class EpisodeFigures:
    """The numbers of one episode. Shares are from 0 to 1; None: there is nothing to tell it by."""

    file: str
    part: int | None  # which episode of the file, from 1 on; None: the whole
    task: str | None  # in words; None: nobody said
    duration_s: float  # until the run begins to end
    engaged_s: float  # of any arm
    idle_share: float | None
    hands: dict[str, HandFigures]
    arms: dict[str, ArmFigures]
    measured: dict[str, MeasuredFigures]  # by arm
    cameras: dict[str, CameraFigures]
    empty_topics: list[str]  # without a message, of those that every run has
    faults: list[Fault]
    fallback_ticks: int
    fallback_share: float | None
    uncertified_ticks: int
    uncertified_share: float | None
    min_distance_mm: float | None  # of the nearest monitored pair, by the controller's reference
    min_margin_mm: float | None  # of the tightest one, less the distance that it keeps
    timing: TimingFigures
    damage: str | None  # why the file could be read no farther
    ended_by: str | None  # the fault that ended the run
    discarded: bool  # by the operator
    success: bool | None  # by the task's own check or the operator; None: nobody said

    @property
    def name(self) -> str:
        return Path(self.file).stem + ("" if self.part is None else f" #{self.part}")


def figures_of(episode: Episode, dropout: float) -> EpisodeFigures:
    """The numbers of an episode; ``dropout`` [s] is the longest time between a hand's poses that is none."""
    ticks, following, count = episode.ticks, episode.ticks.following, len(episode.ticks.t)
    engaged = ticks.engaged.any(axis=1) & following
    return EpisodeFigures(
        file=str(episode.recording.file),
        part=episode.part,
        task=episode.recording.about.notes.get("task"),
        duration_s=float(ticks.t[following][-1]) if following.any() else 0.0,
        engaged_s=float(ticks.dt[engaged].sum()),
        idle_share=idle_share(episode),
        hands={hand: hand_figures(episode, hand, dropout) for hand in episode.hands},
        arms={arm: arm_figures(episode, arm) for arm in episode.arms},
        measured={arm: measured_figures(episode, arm) for arm in episode.arms},
        cameras=camera_figures(episode),
        empty_topics=_empty_topics(episode),
        # Refused presses are none, since nothing moved; nor is the other arm's pause that follows from a fault.
        faults=[
            Fault(event.t, event.arm, str(event.reason.root.kind), sentence(event.reason))
            for event in episode.events
            if is_fault(event) and not is_refusal(event) and event.kind is not ReasonKind.LINKED
        ],
        fallback_ticks=int(ticks.fallback.sum()),
        fallback_share=float(ticks.fallback.mean()) if count else None,
        uncertified_ticks=int((~ticks.certified).sum()),
        uncertified_share=float((~ticks.certified).mean()) if count else None,
        min_distance_mm=_least_mm(ticks.distance),
        min_margin_mm=_least_mm(ticks.margin),
        timing=timing_figures(episode),
        damage=episode.damage,
        ended_by=episode.ended_by,
        discarded=episode.discarded,
        success=episode.success,
    )


def _empty_topics(episode: Episode) -> list[str]:
    """Topics without a message; of a file without an index nobody knows, and nodes may have published nothing."""
    about, counts = episode.recording.about, episode.recording.counts
    if about.source != LOOP or counts is None or not len(episode.ticks.t):
        return []
    asked = (episode.frames.target != episode.frames.reference).any(axis=2).sum(axis=0)  # frames with a target
    expected = list(loop_topics(about.arms))
    expected += [target(arm) for arm, count in zip(about.arms, asked.tolist(), strict=True) if count > _SURELY]
    expected += [hand_pose(name) for name, hand in episode.hands.items() if len(hand.received)]
    return [topic for topic in expected if not counts.get(topic)]


def _least_mm(distances: Array) -> float | None:
    known = distances[np.isfinite(distances)]
    return 1e3 * float(known.min()) if len(known) else None


def timing_figures(episode: Episode) -> TimingFigures:
    """Figures of ticks; missed are those between which more time passed, by what each tick says, than a period."""
    ticks, count = episode.ticks, len(episode.ticks.t)
    if not count:
        return TimingFigures(0, 0, None, 0.0, 0, 0, None, None, None, episode.ended, 0, 0.0, False)
    period = 1.0 / episode.config.nominal_rate_hz
    lost = np.diff(ticks.number, prepend=-1) - 1  # the first tick of a run is number 0
    gaps = np.diff(ticks.t, prepend=0.0) - ticks.dt
    steps = clock_steps(ticks.number, ticks.t, ticks.dt)
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
        repeated_stamps=_repeated_stamps(episode),
        clock_step_s=float(steps[np.argmax(np.abs(steps))]),
        begins_again=bool((np.diff(ticks.following.astype(int)) > 0).any()),
    )


def _repeated_stamps(episode: Episode) -> int | None:
    if episode.recording.about.source != LOOP:
        return None
    ticks = episode.ticks
    return int(((np.diff(ticks.t) <= 0.0) | (np.diff(ticks.now) <= 0.0)).sum())
